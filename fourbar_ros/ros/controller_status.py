# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What the controller says about itself: its status, its diagnostics and its log."""

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.ros.messages import Diagnostics, LATCHED, OK, Recently, status_message, WARN

# Whether there is anything to warn of is looked after every so many ticks: it takes time.
LOOK_EVERY = 25


class ControllerStatus:
    """
    Publishes `controller_status` when it changes, and diagnostics.

    :ivar judged: stamp of the setpoint or trajectory that was judged last.
    """

    def __init__(self, node, controller, log, guard):
        self.judged = ''
        self._node = node
        self._controller = controller
        self._log = log
        self._refused = Recently()
        self._announced = None
        self._problem = ''
        self._ticks = 0
        self._warning = ''
        self._publisher = node.create_publisher(DiagnosticStatus, 'controller_status', LATCHED)
        self._diagnostics = Diagnostics(node, '', self._collect, guard)

    def announce(self, running=False):
        """
        Publish the status if it changed.

        :param running: whether a tick has just been answered.
        """
        controller = self._controller
        if running:
            self._ticks += 1
            if self._ticks % LOOK_EVERY == 1:
                self._warning = controller.momentum.warning(controller.speeds)
        # Every new goal is one more accepted.
        present = (controller.mode, controller.goal is None, controller.accepted,
                   controller.refused, self.judged, controller.settings, controller.problem,
                   controller.branch, controller.wheels.verdicts.tobytes(), self._warning)
        if present == self._announced:
            return
        if controller.problem not in ('', self._problem):
            self._log.warn(controller.problem)
        self._announced, self._problem = present, controller.problem
        goal = '' if controller.goal is None else ' '.join(
            f'{name}={angle:.6f}' for name, angle in zip(LINK_NAMES, controller.goal))
        level, summary = self._summary()
        self._publisher.publish(status_message(
            self._node, '', level, summary, {
                'mode': controller.mode, 'goal': goal, 'branch': controller.branch,
                'setpoint_duration_s': controller.settings.setpoint_duration,
                'accepted': controller.accepted, 'refused': controller.refused,
                'last_refusal': controller.last_refusal, 'judged_stamp_ns': self.judged,
                'problem': controller.problem, 'wheel_faults': self._faults()}))
        self._diagnostics.changed()

    def _faults(self):
        return ', '.join(f'{name}: {fault}'
                         for name, fault in self._controller.wheels.faults().items())

    def _summary(self):
        controller, faults = self._controller, self._faults()
        said = [controller.mode, *(text for text in (controller.problem, faults, self._warning)
                                   if text)]
        return (OK if len(said) == 1 else WARN), ', '.join(said)

    def _collect(self):
        controller = self._controller
        values = {'mode': controller.mode, 'setpoints_accepted': controller.accepted,
                  'setpoints_refused': controller.refused,
                  'last_refusal': controller.last_refusal,
                  'ticks_saturated': controller.saturated, 'problem': controller.problem,
                  'wheel_faults': self._faults(), 'momentum': self._warning}
        if not self._ticks:
            return WARN, 'waiting for flywheel_states and estimate/link_states', values
        level, summary = self._summary()
        if level == OK and self._refused.grew(controller.refused):
            return WARN, f'{controller.mode}, setpoints were refused', values
        return level, summary, values
