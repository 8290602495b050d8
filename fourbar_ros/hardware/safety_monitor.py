# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The host's lookout over four links: what is beyond its limit, and what that must lead to."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_ros.device.arming import DeviceState
from fourbar_ros.device.interface import DeviceFault, Drive, Reaction
from fourbar_ros.hardware.link_telemetry import LinkTelemetry
from fourbar_ros.hardware.messages import LinkState
from fourbar_ros.hardware.safety_table import SafetyTable, SafetyWatch
from fourbar_ros.mechanism import LINK_NAMES, Mechanism


class SafetyMonitor:
    """
    Compares everything that is heard with its limit.

    :param mechanism: limits of its motors.
    :param table: the other limits, and reactions.
    :param links: what is heard of them.
    :param now_ns: of the host's steady clock [ns].
    :ivar findings: of the last look, those that must have consequences now.
    """

    def __init__(self, mechanism: Mechanism, table: SafetyTable, links: Sequence[LinkTelemetry],
                 now_ns: int) -> None:
        self.faults: tuple[DeviceFault, ...] = ()
        self._mechanism = mechanism
        self._table = table
        self._links = links
        self._watch = SafetyWatch(table)
        self._state = DeviceState.DISARMED
        self._since_ns = now_ns
        self._armed_boots = [0 for _ in links]
        # Whether a finding ended the driving and something is still wrong: it may get worse.
        self._watched = False
        self._bad = 0
        self._bad_since_ns = now_ns

    def gate_changed(self, state: DeviceState, now_ns: int) -> None:
        """Take note of another state of the device, and of how links are when they are armed."""
        was, self._state = self._state, state
        self._watched = (was, state) == (DeviceState.ARMED, DeviceState.DISARMED) and bool(
            self.faults)
        if state is DeviceState.ARMED:
            self._since_ns = now_ns
            self._armed_boots = [link.boots for link in self._links]

    def look(self, now_ns: int, drive: Drive, bad: int) -> None:
        """
        Take a look.

        :param drive: what the links were told last.
        :param bad: frames that were no good so far.
        """
        for index, (name, link) in enumerate(zip(LINK_NAMES, self._links)):
            if link.heartbeat_ns is not None:
                self._look_at(index, name, link, now_ns, drive)
        elapsed_s = (now_ns - self._bad_since_ns) * 1e-9
        if elapsed_s >= 1.0:
            rate = (bad - self._bad) / elapsed_s
            self._watch.look(
                'bad_frames', 'bus', rate > self._table['bad_frames'].limit, rate,
                '{0:.0f} frames a second are no good, limit {1:g}', now_ns)
            self._bad, self._bad_since_ns = bad, now_ns
        found = tuple(finding for finding in self._watch.faults()
                      if finding.reaction is not Reaction.WARN)
        self._watched &= bool(found)
        if not self._driving(drive):
            found = tuple(finding for finding in found
                          if self._watched and finding.reaction is Reaction.STOP)
        self.faults = found

    def arming_blockers(self) -> list[str]:
        """Tell what speaks against arming: links, wheels, clocks, and what must not go on."""
        told = [f'{name}: {text}' for name, link in zip(LINK_NAMES, self._links)
                for text in self._obstacles_of(link)]
        told += [finding.text for finding in self._watch.faults()
                 if finding.reaction is not Reaction.WARN and finding.text not in told]
        return told

    def troubles(self) -> dict[str, str]:
        """Tell by link, or bus, what is beyond its limit, the worst first."""
        told: dict[str, str] = {}
        for finding in self._watch.faults():
            # None hides another.
            where = finding.text.partition(':')[0]
            told[where] = '; '.join(filter(None, (told.get(where), finding.text)))
        return told

    def _driving(self, drive: Drive) -> bool:
        """Tell whether a wheel may have power, be it to park it after commands stayed away."""
        return self._state is DeviceState.ARMED or bool(drive.powered.any())

    def _obstacles_of(self, link: LinkTelemetry) -> list[str]:
        if link.heartbeat_ns is None:
            return ['was never heard']
        told = []
        if link.answer_ns is None:
            told.append('its wheel was never heard')
        if not link.clock.settled:
            told.append('its clock is not known yet')
        if link.state not in (LinkState.IDLE, LinkState.COASTING, None):
            way_out = (', call reset_emergency_stop first'
                       if link.state is LinkState.STOPPED else '')
            told.append(f'its electronics say {link.state.name.lower()}{way_out}')
        limit = self._table['wheel_speed_to_arm'].limit
        if abs(link.wheel_speed) > limit:
            told.append(f'its wheel turns at {abs(link.wheel_speed):.3g} rad/s, limit {limit:g}')
        return told

    def _look_at(self, index: int, name: str, link: LinkTelemetry, now_ns: int,
                 drive: Drive) -> None:
        table, look = self._table, self._watch.look
        driving = self._driving(drive)
        assert link.heartbeat_ns is not None
        silence = (now_ns - (link.answer_ns or self._since_ns)) * 1e-9
        look('wheel_silent', name, silence > table['wheel_silent'].limit, silence,
             'its wheel has not answered for {0:.3g} s, limit {1:g}', now_ns)
        silence = (now_ns - link.heartbeat_ns) * 1e-9
        look('heartbeat_lost', name, silence > table['heartbeat_lost'].limit, silence,
             'no heartbeat for {0:.3g} s, limit {1:g}', now_ns)
        boots = link.boots - self._armed_boots[index] if driving else 0
        look('reboot', name, boots > table['reboot'].limit, boots,
             'it has started anew while it was armed', now_ns)
        look('two_of_one_id', name, link.twins > table['two_of_one_id'].limit, link.twins + 1,
             '{0} links answer to its id', now_ns)
        powered = bool(drive.powered[index])
        state = '' if link.state is None else link.state.name.lower()
        look('not_armed', name, powered and link.state not in (LinkState.ARMED, None), state,
             'it was told to drive, but says that it is {0}', now_ns)
        torque_limit = float(self._mechanism.motor_torque_limits[index])
        speed_limit = table['overspeed'].limit * float(self._mechanism.motor_speed_limits[index])
        speed = abs(link.wheel_speed)
        look('overspeed', name, speed > speed_limit, speed,
             f'its wheel turns at {{0:.4g}} rad/s, limit {speed_limit:.4g}', now_ns)
        look('unasked_torque', name, not powered and driving
             and abs(link.torque) > table['unasked_torque'].limit * torque_limit, link.torque,
             'its motor gives {0:.3g} N m without power', now_ns)
        asked = float(drive.values[index])
        by_torque = powered and not bool(drive.by_speed[index])
        look('disagreement', name, by_torque and abs(asked - link.torque)
             > table['disagreement'].limit * torque_limit, link.torque - asked,
             'its motor is {0:.3g} N m off what it was told', now_ns)
        self._look_at_health(name, link, now_ns)

    def _look_at_health(self, name: str, link: LinkTelemetry, now_ns: int) -> None:
        beat, table, look = link.heartbeat, self._table, self._watch.look
        assert beat is not None
        faults = ', '.join(sorted(beat.faults - {'no_limits'}))
        look('link_fault', name, bool(faults), faults, 'its electronics tell of {0}', now_ns)
        for row in ('hot', 'overtemperature'):
            look(row, name, beat.temperature is not None
                 and beat.temperature > table[row].limit, beat.temperature,
                 'it has {0:.3g} deg C, limit {1:g}', now_ns)
        for row in ('low_voltage', 'undervoltage'):
            look(row, name, beat.voltage is not None and beat.voltage < table[row].limit,
                 beat.voltage, 'its supply has {0:.3g} V, at least {1:g}', now_ns)
