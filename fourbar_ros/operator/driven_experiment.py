# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Drive a device with torques of one's own, tick by tick."""

import gc
from math import inf

from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism import FLYWHEEL_NAMES
from fourbar_ros.operator.experiment import Experiment
from fourbar_ros.ros.environment import RosError
from fourbar_ros.ros.messages import RELIABLE, stamp_of
from fourbar_ros.ros.priority import go_first
from fourbar_ros.ros.runtime import deliver
import numpy as np
from sensor_msgs.msg import JointState

# Another publisher of commands may need so long to be found [s].
LOOK_AROUND = 1.0


class DrivenExperiment(Experiment):
    """
    An experiment in which the wheels are driven.

    :param testbed: the operator's node, a TestbedClient.
    """

    def __init__(self, testbed):
        self._commands = None
        self._excitation = None
        self._begin_ns = None
        self._elapsed_s = 0.0
        self._over = False
        super().__init__(testbed)

    def drive(self, excitation, progress=lambda elapsed_s: None):
        """
        Arm, drive and disarm; zero torque before the end, however it ends.

        :param excitation: asked for torques at every tick, see analysis.calibration.excitation.
        :param progress: called with the time so far [s].
        :raises RosError: somebody else drives, the device does not arm, is disarmed, or is silent.
        :raises FourbarError: the excitation must not go on.
        :raises KeyboardInterrupt: a signal came.
        """
        gc.collect()
        gc.freeze()     # a search for garbage outlasts a command timeout
        go_first()
        topic = self.node.resolve_topic_name(names.FLYWHEEL_COMMAND)
        if self.testbed.wait(lambda: self.node.count_publishers(topic), LOOK_AROUND):
            raise RosError(f'{topic} has a publisher already: stop the controller')
        self._commands = self.node.create_publisher(JointState, names.FLYWHEEL_COMMAND, RELIABLE)
        try:
            self.testbed.wait(lambda: self._commands.get_subscription_count() > 0,
                              missing=f'nobody takes {topic}')
            if not self.testbed.wait(lambda: np.isfinite(self.angles).all()):
                raise RosError(f'link_angles has no {", ".join(self.silent_links())}: each link '
                               'needs an absolute sensor')
            self._arm()
            self.begin()
            self._excitation = excitation

            def finished():
                progress(self._elapsed_s)
                self.check_alive()
                if self.status['state'] != 'armed':
                    raise RosError('the device does not drive any more: '
                                   f'{self.status["state"]} ({self.status["reason"]})')
                return self._over
            self.testbed.wait(finished, inf)
        finally:
            self._leave()

    def on_tick(self, message):
        """Answer a tick."""
        super().on_tick(message)
        if self._commands is None:
            return
        efforts = None
        try:
            efforts = self._answer(message)
        except FourbarError:
            self._over = True
            raise       # the operator's node hands it on
        finally:
            self._publish(efforts or dict.fromkeys(FLYWHEEL_NAMES, 0.0))

    def _arm(self):
        armed, message = self.testbed.switch(names.ARM, True)
        if not armed:
            hint = ': stop the controller' if names.FLYWHEEL_COMMAND in message else ''
            raise RosError(f'the device does not arm: {message}{hint}')
        self.testbed.wait(lambda: self.status['state'] == 'armed',
                          missing='the device was not armed')

    def _answer(self, tick):
        """Return the torques that answer a tick, None where there are none."""
        if self._excitation is None or self._over:
            return None
        stamp_ns = stamp_of(tick)
        if self._begin_ns is None:
            self._begin_ns = stamp_ns
        self._elapsed_s = (stamp_ns - self._begin_ns) * 1e-9
        speeds = np.array([tick.velocity[tick.name.index(name)] for name in FLYWHEEL_NAMES])
        efforts = self._excitation.efforts(self._elapsed_s, self.angles.copy(), speeds)
        self._over = efforts is None
        return efforts

    def _publish(self, efforts):
        message = JointState(name=list(efforts), effort=list(map(float, efforts.values())))
        message.header.stamp = self.tick.header.stamp
        self._commands.publish(message)

    def _leave(self):
        """Leave the wheels without torque and the device disarmed, even after a signal."""
        runtime = self.testbed.runtime
        stopping, runtime.stopping = runtime.stopping, False
        runtime.failure, self._over = None, True
        try:
            if self.tick is not None:
                self._publish(dict.fromkeys(FLYWHEEL_NAMES, 0.0))
            self.testbed.switch(names.ARM, False)
        except RosError as error:
            raise RosError(f'{error}: could not disarm, without commands the device stops by '
                           'itself') from None
        finally:
            runtime.stopping = stopping
            deliver([self._commands])
            self.node.destroy_publisher(self._commands)
            self._commands = None
