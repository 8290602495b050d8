# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
ODrives on the wheels, in their CANSimple protocol, and sensor boards on the links.

After the CAN protocol page of the ODrive manual (docs.odriverobotics.com, manual/can-protocol),
firmware 0.6; node 0 is link a. An ODrive knows neither counters nor clocks: its answers are told
apart by asking anew. Link angles and the clocks of their boards come in the prototype's own
messages SYNC, ANGLE and CLOCK, beside which nodes 0 to 3 leave room.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import isfinite, isnan, tau
from typing import Any

from fourbar_ros.hardware.dbc import DbcError, DbcFile, Layout
from fourbar_ros.hardware.dbc_codec import DbcCodec
from fourbar_ros.hardware.messages import (
    BusError,
    Command,
    Frame,
    FrameError,
    Heartbeat,
    Limits,
    LinkState,
    MotorReport,
    Release,
    Stop,
    Sync,
    ToHost,
    ToLinks,
    WheelReport,
)

LINKS = range(4)

# Floats count turns finely enough only up to here; a real one goes on, and is reduced.
TURN = 256 * tau

_IDLE, _CLOSED_LOOP = 1, 8
_BY_TORQUE, _BY_SPEED, _PASSTHROUGH = 1, 2, 1

_INITIALIZING, _SYSTEM_LEVEL = 1 << 0, 1 << 1
_WATCHDOG, _ESTOP = 1 << 24, 1 << 25
# Which bits of Axis_Error are which fault, the one to write first; all others are the driver's.
_ERRORS = {
    'encoder': (1 << 3, 1 << 26),                     # missing estimate, spinout
    'overspeed': (1 << 15,),                          # velocity limit
    'overtemperature': (1 << 13, 1 << 14, 1 << 28),   # motor, inverter, thermistor disconnected
    'undervoltage': (1 << 9,),
}
_DRIVER = 1 << 5
_NO_FAULT = _WATCHDOG | _ESTOP

# Voltage and temperatures of each node are asked for with every so many `Sync`.
_SELDOM = 16
_SENSORS = ('SYNC', 'ANGLE', 'CLOCK')


class OdriveCodec:
    """
    A `Codec` of ODrives and of sensor boards that speak `SYNC`, `ANGLE` and `CLOCK`.

    It has a memory, so there is one for each end of a bus: mode and state are sent only where they
    change, and voltage and temperature are told with the next heartbeat. Until `Limits` were
    written to a link its heartbeats say `no_limits`, for an ODrive does not know.

    :param sensors: of the sensor boards, `prototype` for config/prototype.dbc, or the path of a
        file.
    :param name: of the ODrives, `odrive` for config/odrive.dbc, or the path of a file.
    :param torque_constants: of the four motors [N m/A], because an ODrive limits current; None
        leaves the limits to its own configuration: `Limits` are neither written nor understood.
    :ivar frame_ids: of all its messages.
    :raises DbcError: a file is no DBC, lacks a message or a signal, or both use one identifier.
    :raises BusError: torque constants that are not positive and finite.
    """

    name = 'odrive'
    has_angles = True
    has_clock = True

    def __init__(self, sensors: str = 'prototype', name: str = 'odrive',
                 torque_constants: Sequence[float] | None = None) -> None:
        if torque_constants is not None and not (len(torque_constants) == len(LINKS) and all(
                isfinite(constant) and constant > 0.0 for constant in torque_constants)):
            raise BusError('ODrives need four torque constants, positive and finite, got '
                           f'{list(torque_constants)}: give motor_torque_constants in the '
                           'mechanism file')
        self._sensors = DbcCodec(sensors, _SENSORS)
        file = DbcFile(name)
        constants: Sequence[float | None] = (
            [None] * len(LINKS) if torque_constants is None else list(torque_constants))
        self._axes = [_Axis(file, link, constants[link]) for link in LINKS]
        ids = [frame_id for axis in self._axes for frame_id in (*axis.answers, *axis.orders)]
        if shared := self._sensors.frame_ids & set(ids):
            raise DbcError(f'{file.path} and the sensor boards use the same identifier '
                           f'0x{min(shared):03X}')
        self.frame_ids = self._sensors.frame_ids | frozenset(ids)
        self._answers = {key: value for axis in self._axes for key, value in axis.answers.items()}
        self._orders = {key: value for axis in self._axes for key, value in axis.orders.items()}

    def to_links(self, message: ToLinks) -> Sequence[Frame]:
        """
        Write what the host says.

        :raises FrameError: kind `value`: a number that is not finite or does not fit.
        """
        if isinstance(message, Sync):
            asked = [frame for axis in self._axes for frame in axis.ask]
            link = message.counter % _SELDOM
            # Not before it was heard: what it says of itself goes with a heartbeat.
            if link in LINKS and self._axes[link].heard:
                asked += self._axes[link].ask_seldom
            return [*self._sensors.to_links(message), *asked]
        if isinstance(message, Stop):
            return [axis.estop() for axis in self._axes]
        if isinstance(message, Release):
            return [axis.clear_errors() for axis in self._axes]
        axis = self._axis(message.link)
        return axis.command(message) if isinstance(message, Command) else axis.limit(message)

    def to_host(self, message: ToHost) -> Sequence[Frame]:
        """
        Write what a link says; an ODrive leaves out what it does not know.

        :raises FrameError: likewise.
        """
        axis = self._axis(message.link)
        if isinstance(message, WheelReport):
            return axis.tell_wheel(message)
        if isinstance(message, MotorReport):
            return axis.tell_motor(message)
        if isinstance(message, Heartbeat):
            return axis.tell_health(message)
        return self._sensors.to_host(message)

    def from_links(self, frame: Frame) -> ToHost | None:
        """
        Read at the host what a link says.

        Voltage and temperature repeat the last heartbeat with them in it.

        :returns: the message; None for a frame that is none of a link's.
        :raises FrameError: a wrong length, or what cannot be; of a sensor board, a wrong checksum.
        """
        entry = self._answers.get(frame.frame_id)
        if entry is None:
            return self._sensors.from_links(frame)
        layout, read = entry
        told: ToHost | None = None if frame.remote else read(layout.counts(frame))
        return told

    def from_host(self, frame: Frame) -> ToLinks | None:
        """
        Read at the links what the host says; a mode or a state is a command with the last value.

        :returns: the message; None for a frame that is none of the host's, and for remote frames,
            which ask for what a `Sync` asks for.
        :raises FrameError: likewise.
        """
        entry = self._orders.get(frame.frame_id)
        if entry is None:
            return self._sensors.from_host(frame)
        layout, read = entry
        told: ToLinks | None = None if frame.remote else read(layout.counts(frame))
        return told

    def _axis(self, link: int) -> _Axis:
        if link not in LINKS:
            raise FrameError('value', f'links are 0 to {len(LINKS) - 1}, got {link}')
        return self._axes[link]


# By identifier, the layout of a frame and what reads its counts.
_Readers = dict[int, tuple[Layout, Callable[[Mapping[str, Any]], Any]]]


class _Axis:
    """
    One ODrive, as the host and as itself.

    :ivar answers: by identifier, what reads a frame of the ODrive.
    :ivar orders: by identifier, what reads a frame to it.
    :ivar ask, ask_seldom: what is asked for with every `Sync`, and with some.
    """

    def __init__(self, file: DbcFile, link: int, torque_constant: float | None) -> None:
        self._link = link
        self._constant = torque_constant
        # The host's: what it last told the ODrive, and what that last told of itself.
        self._told: bool | None = None
        self._enabled = False
        self._limited = torque_constant is None
        self._limit: Frame | None = None
        self._voltage: float | None = None
        self._temperature: float | None = None
        self._heartbeat: Heartbeat | None = None
        # The link's: what it was last told.
        self._inputs, self._sequence = [0.0, 0.0], 0
        self._by_speed = self._closed_loop = False

        def layout(message: str) -> Layout:
            return file.layout(f'Axis{link}_{message}', checked=False)

        self._state = layout('Set_Axis_State')
        self._state.count('Axis_Requested_State', 16)
        self._mode = layout('Set_Controller_Mode')
        self._mode.count('Control_Mode', 4)
        self._mode.count('Input_Mode', 4)
        self._speed, self._torque = layout('Set_Input_Vel'), layout('Set_Input_Torque')
        self._input_speed = self._speed.number('Input_Vel', -100.0, 100.0)
        self._input_torque = self._torque.number('Input_Torque', -1.0, 1.0)
        self._limits = layout('Set_Limits')
        self._speed_limit = self._limits.number('Velocity_Limit', 0.0, 100.0)
        self._current_limit = self._limits.number('Current_Limit', 0.0, 10.0)
        self._estop, self._clear = layout('Estop'), layout('Clear_Errors')
        self._beat = layout('Heartbeat')
        self._error = self._beat.count('Axis_Error', 1 << 32)
        self._axis_state = self._beat.count('Axis_State', 256)
        self._estimates = layout('Get_Encoder_Estimates')
        self._position = self._estimates.number('Pos_Estimate', -1000.0, 1000.0)
        self._velocity = self._estimates.number('Vel_Estimate', -100.0, 100.0)
        self._torques = layout('Get_Torques')
        self._torque_estimate = self._torques.number('Torque_Estimate', -1.0, 1.0)
        self._torque_target = self._torques.number('Torque_Target', -1.0, 1.0)
        self._bus = layout('Get_Bus_Voltage_Current')
        self._bus_voltage = self._bus.number('Bus_Voltage', 0.0, 60.0)
        self._hot = layout('Get_Temperature')
        self._temperatures = {name: self._hot.number(name, 0.0, 100.0)
                              for name in ('FET_Temperature', 'Motor_Temperature')}

        self.answers: _Readers = _by_identifier(
            (self._beat, self._read_beat), (self._estimates, self._read_estimates),
            (self._torques, self._read_torques), (self._bus, self._read_bus),
            (self._hot, self._read_temperatures))
        self.orders: _Readers = _by_identifier(
            (self._estop, lambda counts: Stop()), (self._clear, lambda counts: Release()),
            (self._state, self._read_state), (self._mode, self._read_mode),
            (self._speed, self._read_speed), (self._torque, self._read_torque),
            (self._limits, self._read_limits))
        self.ask, self.ask_seldom = (
            [Frame(message.frame_id, b'', True) for message in messages]
            for messages in ((self._estimates, self._torques), (self._bus, self._hot)))

    @property
    def heard(self) -> bool:
        """Whether a heartbeat came."""
        return self._heartbeat is not None

    # The host writes

    def estop(self) -> Frame:
        self._enabled, self._told = False, None
        return self._estop.frame({})

    def clear_errors(self) -> Frame:
        self._enabled, self._told = False, None
        return self._clear.frame({})

    def command(self, message: Command) -> list[Frame]:
        if message.by_speed:
            drive = self._speed.frame({'Input_Vel': self._input_speed.write(message.value / tau)})
        else:
            drive = self._torque.frame({'Input_Torque': self._input_torque.write(message.value)})
        if not message.enable:
            # Every time: one that is lost must not leave the power on.
            self._enabled, self._told = False, None
            return [self._state.frame({'Axis_Requested_State': _IDLE})]
        # One that was started anew, unseen, knows only its own limits.
        frames = [] if self._enabled or self._limit is None else [self._limit]
        frames.append(drive)
        if self._told is not message.by_speed:
            frames.append(self._mode.frame({
                'Control_Mode': _BY_SPEED if message.by_speed else _BY_TORQUE,
                'Input_Mode': _PASSTHROUGH}))
        if not self._enabled:
            # Not every time: who disarmed by itself must stay so until it is disarmed and armed.
            frames.append(self._state.frame({'Axis_Requested_State': _CLOSED_LOOP}))
        if frames[-1] is not drive:
            # Before, so that it does not begin with what it was last told in that mode; and after,
            # in case it forgot.
            frames.append(drive)
        self._enabled, self._told = True, message.by_speed
        return frames

    def limit(self, message: Limits) -> list[Frame]:
        if self._constant is None:
            return []
        if message.speed < 0.0:
            raise self._speed_limit.refusal(message.speed)
        if message.torque < 0.0:
            raise self._current_limit.refusal(message.torque)
        counts = {'Velocity_Limit': self._speed_limit.write_at_most(message.speed / tau),
                  'Current_Limit': self._current_limit.write_at_most(
                      message.torque / self._constant)}
        self._limited, self._limit = True, self._limits.frame(counts)
        return [self._limit]

    # The host reads

    def _read_estimates(self, counts: Mapping[str, Any]) -> WheelReport:
        position = self._position.read(counts['Pos_Estimate'])
        velocity = self._velocity.read(counts['Vel_Estimate'])
        return WheelReport(self._link, None, position * tau % TURN, TURN, None, 0, velocity * tau)

    def _read_torques(self, counts: Mapping[str, Any]) -> MotorReport:
        return MotorReport(
            self._link, self._torque_estimate.read(counts['Torque_Estimate']), None, None)

    def _read_bus(self, counts: Mapping[str, Any]) -> Heartbeat | None:
        self._voltage = self._bus_voltage.read(counts['Bus_Voltage'])
        return self._repeated()

    def _read_temperatures(self, counts: Mapping[str, Any]) -> Heartbeat | None:
        # A motor without a thermistor has none; the hotter of both counts.
        told = [number.read(counts[name]) for name, number in self._temperatures.items()
                if not isnan(counts[name])]
        self._temperature = max(told, default=None)
        return self._repeated()

    def _read_beat(self, counts: Mapping[str, Any]) -> Heartbeat:
        error = self._error.read(counts['Axis_Error'])
        faults = {fault for fault, bits in _ERRORS.items() if any(error & bit for bit in bits)}
        if error & ~(sum(map(sum, _ERRORS.values())) | _NO_FAULT):
            faults.add('driver')
        if error & _ESTOP:
            state = LinkState.STOPPED
        elif faults:
            state = LinkState.FAULT
        elif error & _WATCHDOG:
            state = LinkState.COASTING
        elif self._axis_state.read(counts['Axis_State']) == _CLOSED_LOOP:
            state = LinkState.ARMED
        else:
            state = LinkState.IDLE
        if error & _INITIALIZING and self._constant is not None:
            # It has just been started, and knows only its own configuration.
            self._limited = False
        self._heartbeat = Heartbeat(self._link, None, state, frozenset(faults))
        return self._completed(self._heartbeat)

    def _repeated(self) -> Heartbeat | None:
        return None if self._heartbeat is None else self._completed(self._heartbeat)

    def _completed(self, heartbeat: Heartbeat) -> Heartbeat:
        faults = heartbeat.faults if self._limited else heartbeat.faults | {'no_limits'}
        return replace(heartbeat, faults=faults, voltage=self._voltage,
                       temperature=self._temperature)

    # The link writes

    def tell_wheel(self, message: WheelReport) -> list[Frame]:
        speed = 0.0 if message.speed is None else message.speed
        return [self._estimates.frame({
            'Pos_Estimate': self._position.write(message.angle / tau),
            'Vel_Estimate': self._velocity.write(speed / tau)})]

    def tell_motor(self, message: MotorReport) -> list[Frame]:
        return [self._torques.frame({
            'Torque_Target': self._torque_target.write(message.torque),
            'Torque_Estimate': self._torque_estimate.write(message.torque)})]

    def tell_health(self, message: Heartbeat) -> list[Frame]:
        error = sum(bits[0] for fault, bits in _ERRORS.items() if fault in message.faults)
        if 'driver' in message.faults:
            error |= _DRIVER
        if message.state is LinkState.FAULT and not error:
            error = _SYSTEM_LEVEL
        error |= {LinkState.STOPPED: _ESTOP, LinkState.COASTING: _WATCHDOG}.get(message.state, 0)
        armed = message.state is LinkState.ARMED
        frames = [self._beat.frame({
            'Axis_Error': error, 'Axis_State': _CLOSED_LOOP if armed else _IDLE})]
        if message.voltage is not None:
            frames.append(self._bus.frame({
                'Bus_Voltage': self._bus_voltage.write(message.voltage)}))
        if message.temperature is not None:
            frames.append(self._hot.frame({
                name: number.write(message.temperature)
                for name, number in self._temperatures.items()}))
        return frames

    # The link reads

    def _read_state(self, counts: Mapping[str, Any]) -> Command:
        state = counts['Axis_Requested_State']
        if state not in (_IDLE, _CLOSED_LOOP):
            raise FrameError('value', f'{self._state.name}: Axis_Requested_State must be {_IDLE} '
                                      f'or {_CLOSED_LOOP}, got {state}')
        self._closed_loop = state == _CLOSED_LOOP
        return self._commanded()

    def _read_mode(self, counts: Mapping[str, Any]) -> Command:
        mode, source = counts['Control_Mode'], counts['Input_Mode']
        if mode not in (_BY_TORQUE, _BY_SPEED) or source != _PASSTHROUGH:
            raise FrameError('value', f'{self._mode.name}: Control_Mode must be {_BY_TORQUE} or '
                                      f'{_BY_SPEED} and Input_Mode {_PASSTHROUGH}, got {mode} and '
                                      f'{source}')
        self._by_speed = mode == _BY_SPEED
        return self._commanded()

    def _read_speed(self, counts: Mapping[str, Any]) -> Command:
        self._inputs[1] = self._input_speed.read(counts['Input_Vel']) * tau
        return self._commanded()

    def _read_torque(self, counts: Mapping[str, Any]) -> Command:
        self._inputs[0] = self._input_torque.read(counts['Input_Torque'])
        return self._commanded()

    def _read_limits(self, counts: Mapping[str, Any]) -> Limits | None:
        speed = self._speed_limit.read(counts['Velocity_Limit'])
        current = self._current_limit.read(counts['Current_Limit'])
        if speed < 0.0:
            raise self._speed_limit.refusal(speed)
        if current < 0.0:
            raise self._current_limit.refusal(current)
        if self._constant is None:
            return None
        return Limits(self._link, current * self._constant, speed * tau)

    def _commanded(self) -> Command:
        """Return what the motor is told as a whole, numbered as nothing on the bus does."""
        self._sequence = (self._sequence + 1) % 256
        return Command(self._link, self._inputs[self._by_speed], self._by_speed,
                       self._closed_loop, self._sequence)


def _by_identifier(*readers: tuple[Layout, Callable[[Mapping[str, Any]], Any]]) -> _Readers:
    return {reader[0].frame_id: reader for reader in readers}
