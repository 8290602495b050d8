# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What a device says at every tick, and when its gate changes."""

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.device.arming import DeviceState
from fourbar_ros.mechanism import FLYWHEEL_NAMES
from fourbar_ros.ros.messages import (
    ERROR,
    JointStatePublisher,
    LATCHED,
    OK,
    status_message,
    TABLE_FRAME,
)

LEVELS = {DeviceState.DISARMED: OK, DeviceState.ARMED: OK,
          DeviceState.EMERGENCY_STOP: ERROR, DeviceState.FAULT: ERROR}
TIMING_NAMES = ('round_trip_s', 'command_age_s', 'lost', 'step_s')


class DeviceTopics:
    """
    Publish samples, timing and the state of the gate.

    :param mechanism: name of it, for people.
    """

    def __init__(self, node, testbed, mechanism):
        self._node = node
        self._gate = testbed.gate
        self._device = device = testbed.device
        self._mechanism = mechanism
        self._announced = None
        self._links = JointStatePublisher(
            node, 'link_angles', device.sensor_names,
            ('position', 'velocity') if device.measures_rates else ('position',),
            frame=TABLE_FRAME)
        self._wheels = JointStatePublisher(
            node, 'flywheel_states', FLYWHEEL_NAMES, ('position', 'velocity', 'effort'))
        self._timing = JointStatePublisher(node, 'timing', TIMING_NAMES, ('position',))
        self._status = node.create_publisher(DiagnosticStatus, 'device_status', LATCHED)

    def publish_samples(self, samples):
        """Publish what was measured; the tick comes after everything that belongs to it."""
        self._samples = samples
        self.send_again(links=True)

    def send_again(self, links):
        """
        Send the last tick once more, as it was.

        :param links: also the link angles that belong to it.
        """
        samples = self._samples
        for sample in samples.links if links else ():
            self._links.publish(sample.stamp_ns, sample.angles, sample.rates, names=sample.names)
        wheels = samples.wheels
        if samples.complete:
            self._wheels.publish(
                samples.stamp_ns, wheels.angles, wheels.speeds, wheels.efforts)

    def publish_timing(self, stamp_ns, timing):
        """Publish what is known of how the loop keeps time, and the device."""
        scalars = {name: getattr(timing, name) for name in TIMING_NAMES}
        scalars.update(zip(self._device.timing_names, self._samples.timing))
        known = tuple(name for name, value in scalars.items() if value is not None)
        self._timing.publish(stamp_ns, [scalars[name] for name in known], names=known)

    def announce(self):
        """Publish the gate's state if it changed; tell whether it did."""
        gate = self._gate
        present = gate.state, gate.reason, gate.since_ns
        if present == self._announced:
            return False
        self._announced = present
        self._status.publish(status_message(
            self._node, self._device.description, LEVELS[gate.state],
            f'{gate.state.value}: {gate.reason}', {
                'state': gate.state.value, 'reason': gate.reason,
                'since': f'{gate.since_ns * 1e-9:.9f}', 'mechanism': self._mechanism}))
        self._node.get_logger().info(f'{gate.state.value}: {gate.reason}')
        return True
