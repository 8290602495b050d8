# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Comparison of the telemetry of four links with the safety rules."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_ros.device.arming import DeviceState
from fourbar_ros.device.interface import DeviceFault, Drive, Reaction
from fourbar_ros.hardware.link_telemetry import LinkTelemetry
from fourbar_ros.hardware.messages import LinkState
from fourbar_ros.hardware.safety_table import CONDITIONS, SafetyTable
from fourbar_ros.mechanism import LINK_NAMES, Mechanism


class SafetyMonitor:
    """
    Checks every rule at every tick.

    :param mechanism: has the limits of the motors.
    :param table: limits and reactions.
    :param links: telemetry of the links.
    :param now_ns: time of the host's monotonic clock [ns].
    :ivar faults: of the last check, those to which the device must react now.
    """

    def __init__(self, mechanism: Mechanism, table: SafetyTable, links: Sequence[LinkTelemetry],
                 now_ns: int) -> None:
        self.faults: tuple[DeviceFault, ...] = ()
        self._mechanism = mechanism
        self._table = table
        self._limits = {rule: row.limit for rule, row in table.items()}
        self._links = links
        # By rule and subject (a link or the bus): since when its limit is exceeded [ns], and the
        # message once that lasts too long.
        self._exceeded_ns: dict[tuple[str, str], int] = {}
        self._violations: dict[tuple[str, str], str] = {}
        self._state = DeviceState.DISARMED
        self._armed_ns = now_ns
        self._restarts_at_arming = [0 for _ in links]
        # Whether a fault has disarmed the device and is still present: it may become a stop.
        self._escalates = False
        self._rejected_frames = 0
        self._rejected_since_ns = now_ns

    def arming_changed(self, state: DeviceState, now_ns: int) -> None:
        """Take over the state of the device, and the number of restarts at arming."""
        before, self._state = self._state, state
        self._escalates = (before, state) == (DeviceState.ARMED, DeviceState.DISARMED) and bool(
            self.faults)
        if state is DeviceState.ARMED:
            self._armed_ns = now_ns
            self._restarts_at_arming = [link.restarts for link in self._links]

    def check(self, now_ns: int, drive: Drive, rejected_frames: int) -> None:
        """
        Compare the telemetry with the rules.

        :param drive: the last one that was sent to the links.
        :param rejected_frames: number of rejected frames since the start.
        """
        for index, (name, link) in enumerate(zip(LINK_NAMES, self._links)):
            if link.heartbeat_ns is not None:
                self._check_link(index, name, link, now_ns, drive)
        elapsed_s = (now_ns - self._rejected_since_ns) * 1e-9
        if elapsed_s >= 1.0:
            rate = (rejected_frames - self._rejected_frames) / elapsed_s
            self._check('bad_frames', 'bus', rate > self._limits['bad_frames'], rate, now_ns)
            self._rejected_frames, self._rejected_since_ns = rejected_frames, now_ns
        faults = tuple(fault for fault in self._sorted_faults()
                       if fault.reaction is not Reaction.WARN)
        self._escalates &= bool(faults)
        if not self._is_driving(drive):
            faults = tuple(fault for fault in faults
                           if self._escalates and fault.reaction is Reaction.STOP)
        self.faults = faults

    def arming_blockers(self) -> list[str]:
        """Return what prevents arming: state of links, wheels and clocks, and present faults."""
        blockers = [f'{name}: {text}' for name, link in zip(LINK_NAMES, self._links)
                    for text in self._link_blockers(link)]
        return [*blockers, *(fault.text for fault in self._sorted_faults()
                             if fault.reaction is not Reaction.WARN)]

    def diagnostics(self) -> dict[str, str]:
        """Return by link, or bus, the present faults, the most severe first."""
        texts: dict[str, list[str]] = {}
        for fault in self._sorted_faults():
            texts.setdefault(fault.text.partition(':')[0], []).append(fault.text)
        return {subject: '; '.join(lines) for subject, lines in texts.items()}

    def _sorted_faults(self) -> list[DeviceFault]:
        """Return all present faults, the most severe first."""
        faults = [DeviceFault(self._table[rule].level, f'{subject}: {rule}: {text}')
                  for (rule, subject), text in self._violations.items()]
        return sorted(faults, key=lambda fault: -fault.reaction)

    def _is_driving(self, drive: Drive) -> bool:
        """Tell whether a wheel may have power, armed or after a command timeout."""
        return self._state is DeviceState.ARMED or bool(drive.powered.any())

    def _link_blockers(self, link: LinkTelemetry) -> list[str]:
        if link.heartbeat_ns is None:
            return ['no heartbeat since start']
        blockers = []
        if link.answer_ns is None:
            blockers.append('no answer from the wheel since start')
        if not link.clock.settled:
            blockers.append('the offset of its clock is not estimated yet')
        if link.state not in (LinkState.IDLE, LinkState.COASTING, None):
            remedy = (', call reset_emergency_stop first'
                      if link.state is LinkState.STOPPED else '')
            blockers.append(f'its state is {link.state.name.lower()}{remedy}')
        limit, speed = self._limits['wheel_speed_to_arm'], abs(link.wheel_speed)
        if speed > limit:
            text = CONDITIONS['wheel_speed_to_arm'].text.format(value=speed, limit=limit)
            blockers.append(f'wheel_speed_to_arm: {text}')
        return blockers

    def _check_link(self, index: int, name: str, link: LinkTelemetry, now_ns: int, drive: Drive
                    ) -> None:
        limits = self._limits

        def check(rule: str, exceeded: bool, value: object, limit: float | None = None) -> None:
            self._check(rule, name, exceeded, value, now_ns, limit)

        is_driving, powered = self._is_driving(drive), bool(drive.powered[index])
        heartbeat = link.heartbeat
        assert heartbeat is not None and link.heartbeat_ns is not None
        silence_s = (now_ns - (link.answer_ns or self._armed_ns)) * 1e-9
        check('wheel_silent', silence_s > limits['wheel_silent'], silence_s)
        silence_s = (now_ns - link.heartbeat_ns) * 1e-9
        check('heartbeat_lost', silence_s > limits['heartbeat_lost'], silence_s)
        restarts = link.restarts - self._restarts_at_arming[index] if is_driving else 0
        check('reboot', restarts > limits['reboot'], restarts)
        check('two_of_one_id', link.duplicates > limits['two_of_one_id'], link.duplicates + 1)
        check('not_armed', powered and link.state not in (LinkState.ARMED, None),
              '' if link.state is None else link.state.name.lower())
        speed = abs(link.wheel_speed)
        limit = limits['overspeed'] * float(self._mechanism.motor_speed_limits[index])
        check('overspeed', speed > limit, speed, limit)
        torque_limit = float(self._mechanism.motor_torque_limits[index])
        limit = limits['unasked_torque'] * torque_limit
        check('unasked_torque', not powered and is_driving and abs(link.torque) > limit,
              link.torque, limit)
        difference = link.torque - float(drive.values[index])
        limit = limits['disagreement'] * torque_limit
        by_torque = powered and not bool(drive.by_speed[index])
        check('disagreement', by_torque and abs(difference) > limit, difference, limit)
        faults = ', '.join(sorted(heartbeat.faults - {'no_limits'}))
        check('link_fault', bool(faults), faults)
        for rule in ('hot', 'overtemperature'):
            temperature = heartbeat.temperature
            check(rule, temperature is not None and temperature > limits[rule], temperature)
        for rule in ('low_voltage', 'undervoltage'):
            voltage = heartbeat.voltage
            check(rule, voltage is not None and voltage < limits[rule], voltage)

    def _check(self, rule: str, subject: str, exceeded: bool, value: object, now_ns: int,
               limit: float | None = None) -> None:
        """
        Update the violation of one rule.

        :param subject: the link, or the bus.
        :param exceeded: whether the limit is exceeded now.
        :param limit: shown in the message, by default that of the table.
        """
        key = rule, subject
        if not exceeded:
            self._exceeded_ns.pop(key, None)
            self._violations.pop(key, None)
            return
        since_ns = self._exceeded_ns.setdefault(key, now_ns)
        if now_ns - since_ns >= self._table[rule].lasting * 1e9:
            self._violations[key] = CONDITIONS[rule].text.format(
                value=value, limit=self._limits[rule] if limit is None else limit)
