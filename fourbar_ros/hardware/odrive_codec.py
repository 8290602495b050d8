# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
ODrive motor drivers on the wheels (CANSimple protocol) and sensor boards on the links.

Source: CAN protocol page of the ODrive manual (docs.odriverobotics.com, manual/can-protocol),
firmware 0.6; node 0 drives link a. An ODrive has neither a `Sync` counter nor a clock: the host
requests every answer with a remote frame. Link angles and the clocks of the sensor boards use the
prototype's messages SYNC, ANGLE and CLOCK; their identifiers do not collide with nodes 0 to 3.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isfinite, tau
from typing import Any

from fourbar_ros.hardware import messages
from fourbar_ros.hardware.dbc import (
    DbcError,
    DbcFile,
    Integer,
    MessageCodec,
    NanNumber,
    Number,
    UpperLimit,
)
from fourbar_ros.hardware.dbc_codec import DbcCodec
from fourbar_ros.hardware.messages import Command, Frame, FrameError, Heartbeat, LinkState

LINKS = range(4)

# Period of reported wheel angles [rad]: an ODrive counts turns in float32, whose resolution falls
# with the number of turns.
TURN = 256 * tau

# Values of Axis_Requested_State and Axis_State, Control_Mode and Input_Mode.
_IDLE, _CLOSED_LOOP = 1, 8
_TORQUE_CONTROL, _VELOCITY_CONTROL, _PASSTHROUGH = 1, 2, 1

# Bits of Axis_Error.
_INITIALIZING, _SYSTEM_LEVEL = 1 << 0, 1 << 1
_WATCHDOG, _ESTOP = 1 << 24, 1 << 25
# Bits of Axis_Error by fault, first the one to encode; all other bits are a `driver` fault.
_ERRORS = {
    'encoder': (1 << 3, 1 << 26),                     # missing estimate, spinout
    'overspeed': (1 << 15,),                          # velocity limit
    'overtemperature': (1 << 13, 1 << 14, 1 << 28),   # motor, inverter, thermistor disconnected
    'undervoltage': (1 << 9,),
}
_DRIVER = 1 << 5
_NO_DRIVER_FAULT = sum(map(sum, _ERRORS.values())) | _WATCHDOG | _ESTOP

# Number of `Sync` between two requests for voltage and temperature of a node.
_HEALTH_EVERY = 16
_SENSOR_MESSAGES = ('SYNC', 'ANGLE', 'CLOCK')


class OdriveCodec:
    """
    A `Codec` of ODrives and of sensor boards that send `ANGLE` and `CLOCK` and receive `SYNC`.

    A codec has a state, so each end of a bus needs its own: mode and axis state are sent only when
    they change, and voltage and temperature are reported with the next heartbeat. Heartbeats
    report `no_limits` until `Limits` were sent to the link, since an ODrive does not report it.

    :param sensors: of the sensor boards, `prototype` for config/prototype.dbc, or the path of a
        file.
    :param name: of the ODrives, `odrive` for config/odrive.dbc, or the path of a file.
    :param torque_constants: of the four motors [N m/A], because an ODrive limits current; None
        leaves the limits to its own configuration: `Limits` are neither encoded nor decoded.
    :ivar frame_ids: identifiers of all messages.
    :raises DbcError: a file is no DBC, lacks a message or a signal, or both use one identifier.
    :raises BusError: a torque constant is not positive and finite.
    """

    def __init__(self, sensors: str = 'prototype', name: str = 'odrive',
                 torque_constants: Sequence[float] | None = None) -> None:
        if torque_constants is not None and not (len(torque_constants) == len(LINKS) and all(
                isfinite(constant) and constant > 0.0 for constant in torque_constants)):
            raise messages.BusError(
                'ODrives need four torque constants, positive and finite, got '
                f'{list(torque_constants)}: give motor_torque_constants in the mechanism file',
                name='motor_torque_constants', value=list(torque_constants), limit=0.0)
        self._sensors = DbcCodec(sensors, _SENSOR_MESSAGES)
        file = DbcFile(name)
        self._axes = [
            _Axis(file, link, None if torque_constants is None else torque_constants[link])
            for link in LINKS]
        self._from_links = dict(ChainMap(*(axis.from_link for axis in self._axes)))
        self._from_host = dict(ChainMap(*(axis.from_host for axis in self._axes)))
        ids = self._from_links.keys() | self._from_host.keys()
        if shared := self._sensors.frame_ids & ids:
            raise DbcError(f'{file.path} and the sensor boards use the same identifier '
                           f'0x{min(shared):03X}', place=str(file.path), value=min(shared))
        self.frame_ids = self._sensors.frame_ids | ids

    def to_links(self, message: messages.ToLinks) -> Sequence[Frame]:
        """
        Encode a message of the host.

        :raises FrameError: kind `value`: a number is not finite or does not fit.
        """
        if isinstance(message, messages.Sync):
            requests = [frame for axis in self._axes for frame in axis.requests]
            link = message.counter % _HEALTH_EVERY
            # Health is reported with a heartbeat, so it is useless before the first one.
            if link in LINKS and self._axes[link].heartbeat is not None:
                requests += self._axes[link].health_requests
            return [*self._sensors.to_links(message), *requests]
        if isinstance(message, messages.Stop):
            return [axis.stop() for axis in self._axes]
        if isinstance(message, messages.Release):
            return [axis.release() for axis in self._axes]
        axis = self._axis(message.link)
        return axis.command(message) if isinstance(message, Command) else axis.limit(message)

    def to_host(self, message: messages.ToHost) -> Sequence[Frame]:
        """
        Encode a message of a link, without what an ODrive does not report.

        :raises FrameError: kind `value`, as :meth:`to_links`.
        """
        axis = self._axis(message.link)
        if isinstance(message, messages.WheelReport):
            return axis.report_wheel(message)
        if isinstance(message, messages.MotorReport):
            return axis.report_motor(message)
        if isinstance(message, Heartbeat):
            return axis.report_health(message)
        return self._sensors.to_host(message)

    def from_links(self, frame: Frame) -> messages.ToHost | None:
        """
        Decode at the host a message of a link.

        A frame with voltage or temperature repeats the last heartbeat with the new value.

        :returns: the message; None for a frame that no link sends.
        :raises FrameError: wrong length or an invalid value; from a sensor board, wrong checksum.
        """
        if frame.frame_id not in self._from_links:
            return self._sensors.from_links(frame)
        message: messages.ToHost | None = _decode(frame, *self._from_links[frame.frame_id])
        return message

    def from_host(self, frame: Frame) -> messages.ToLinks | None:
        """
        Decode at a link a message of the host; mode and axis state become a `Command`.

        :returns: the message; None for a frame that the host does not send, and for remote
            frames, since the answers to `Sync` hold the requested values.
        :raises FrameError: as :meth:`from_links`.
        """
        if frame.frame_id not in self._from_host:
            return self._sensors.from_host(frame)
        message: messages.ToLinks | None = _decode(frame, *self._from_host[frame.frame_id])
        return message

    def _axis(self, link: int) -> _Axis:
        messages.check_link(link)
        return self._axes[link]


# By identifier: codec of a message, and function from its signal values to our message.
_Decoders = dict[int, tuple[MessageCodec, Callable[..., Any]]]


def _decode(frame: Frame, codec: MessageCodec, decode: Callable[..., Any]) -> Any:
    return None if frame.remote else decode(**codec.decode(frame))


class _Ignored(Number):
    """A number that a link sends and the host does not use, so that it is not checked."""

    def decode(self, count: float) -> None:
        return None


class _Axis:
    """
    One ODrive, with the state of both ends of the bus.

    :ivar from_link, from_host: decoders of the frames of either end, by identifier.
    :ivar requests, health_requests: remote frames sent with every `Sync`, and with some.
    :ivar heartbeat: the last one at the host, None before the first.
    """

    def __init__(self, file: DbcFile, link: int, torque_constant: float | None) -> None:
        self._link = link
        self._torque_constant = torque_constant
        # State of the host: the mode and the axis state that it sent, and the reported health.
        self._sent_by_speed: bool | None = None
        self._enabled = False
        self._limits_sent = torque_constant is None
        self._limits_frame: Frame | None = None
        self._voltage: float | None = None
        self._temperature: float | None = None
        self.heartbeat: Heartbeat | None = None
        # State of the link: the last received inputs, mode and axis state.
        self._torque, self._speed, self._sequence = 0.0, 0.0, 0
        self._by_speed = self._closed_loop = False

        def message(name: str, **signals: Any) -> MessageCodec:
            return file.message(f'Axis{link}_{name}', signals, has_checksum=False)

        self._state = message('Set_Axis_State', Axis_Requested_State=Integer(16))
        self._mode = message('Set_Controller_Mode', Control_Mode=Integer(4), Input_Mode=Integer(4))
        self._input_speed = message('Set_Input_Vel', Input_Vel=Number(-100.0, 100.0))
        self._input_torque = message('Set_Input_Torque', Input_Torque=Number(-1.0, 1.0))
        self._limits = message('Set_Limits', Velocity_Limit=UpperLimit(0.0, 100.0),
                               Current_Limit=UpperLimit(0.0, 10.0))
        self._estop, self._clear = message('Estop'), message('Clear_Errors')
        self._beat = message('Heartbeat', Axis_Error=Integer(1 << 32), Axis_State=Integer(256))
        self._estimates = message('Get_Encoder_Estimates', Pos_Estimate=Number(-1000.0, 1000.0),
                                  Vel_Estimate=Number(-100.0, 100.0))
        self._torques = message('Get_Torques', Torque_Target=_Ignored(-1.0, 1.0),
                                Torque_Estimate=Number(-1.0, 1.0))
        self._bus = message('Get_Bus_Voltage_Current', Bus_Voltage=Number(0.0, 60.0))
        self._temperatures = message('Get_Temperature', FET_Temperature=NanNumber(0.0, 100.0),
                                     Motor_Temperature=NanNumber(0.0, 100.0))

        def by_identifier(*decoders: tuple[MessageCodec, Callable[..., Any]]) -> _Decoders:
            return {decoder[0].frame_id: decoder for decoder in decoders}

        self.from_link = by_identifier(
            (self._beat, self._decode_heartbeat), (self._estimates, self._decode_wheel),
            (self._torques, self._decode_motor), (self._bus, self._decode_voltage),
            (self._temperatures, self._decode_temperatures))
        self.from_host = by_identifier(
            (self._estop, messages.Stop), (self._clear, messages.Release),
            (self._state, self._decode_state), (self._mode, self._decode_mode),
            (self._input_speed, self._decode_speed),
            (self._input_torque, self._decode_torque), (self._limits, self._decode_limits))
        self.requests, self.health_requests = (
            [Frame(codec.frame_id, b'', True) for codec in codecs]
            for codecs in ((self._estimates, self._torques), (self._bus, self._temperatures)))

    # The host encodes.

    def stop(self) -> Frame:
        self._enabled, self._sent_by_speed = False, None
        return self._estop.encode({})

    def release(self) -> Frame:
        self._enabled, self._sent_by_speed = False, None
        return self._clear.encode({})

    def command(self, message: Command) -> list[Frame]:
        if message.by_speed:
            drive = self._input_speed.encode({'Input_Vel': message.value / tau})
        else:
            drive = self._input_torque.encode({'Input_Torque': message.value})
        if not message.enable:
            # Sent every time, since a lost frame must not leave the power on.
            self._enabled, self._sent_by_speed = False, None
            return [self._state.encode({'Axis_Requested_State': _IDLE})]
        # An ODrive that has restarted unnoticed knows only its own limits.
        frames = [] if self._enabled or self._limits_frame is None else [self._limits_frame]
        frames.append(drive)
        if self._sent_by_speed is not message.by_speed:
            frames.append(self._mode.encode({
                'Control_Mode': _VELOCITY_CONTROL if message.by_speed else _TORQUE_CONTROL,
                'Input_Mode': _PASSTHROUGH}))
        if not self._enabled:
            # Sent once: an ODrive that disarmed itself must stay so until it is armed again.
            frames.append(self._state.encode({'Axis_Requested_State': _CLOSED_LOOP}))
        if frames[-1] is not drive:
            # Before the change, so that it does not start with an old input of that mode; and
            # after it, in case the change cleared the input.
            frames.append(drive)
        self._enabled, self._sent_by_speed = True, message.by_speed
        return frames

    def limit(self, message: messages.Limits) -> list[Frame]:
        if self._torque_constant is None:
            return []
        self._limits_frame = self._limits.encode({
            'Velocity_Limit': message.speed / tau,
            'Current_Limit': message.torque / self._torque_constant})
        self._limits_sent = True
        return [self._limits_frame]

    # The host decodes; arguments are signals of the file.

    def _decode_wheel(self, Pos_Estimate: float, Vel_Estimate: float) -> messages.WheelReport:
        return messages.WheelReport(
            self._link, None, Pos_Estimate * tau % TURN, TURN, None, 0, Vel_Estimate * tau)

    def _decode_motor(self, Torque_Estimate: float, Torque_Target: None) -> messages.MotorReport:
        return messages.MotorReport(self._link, Torque_Estimate)

    def _decode_voltage(self, Bus_Voltage: float) -> Heartbeat | None:
        self._voltage = Bus_Voltage
        return self._health()

    def _decode_temperatures(self, **temperatures: float | None) -> Heartbeat | None:
        # NaN stands for a missing thermistor; the higher temperature counts.
        self._temperature = max(
            (value for value in temperatures.values() if value is not None), default=None)
        return self._health()

    def _decode_heartbeat(self, Axis_Error: int, Axis_State: int) -> Heartbeat | None:
        faults = {fault for fault, bits in _ERRORS.items() if Axis_Error & sum(bits)}
        if Axis_Error & ~_NO_DRIVER_FAULT:
            faults.add('driver')
        if Axis_Error & _ESTOP:
            state = LinkState.STOPPED
        elif faults:
            state = LinkState.FAULT
        elif Axis_Error & _WATCHDOG:
            state = LinkState.COASTING
        else:
            state = LinkState.ARMED if Axis_State == _CLOSED_LOOP else LinkState.IDLE
        if Axis_Error & _INITIALIZING and self._torque_constant is not None:
            # It has just started, with the limits of its own configuration.
            self._limits_sent = False
        self.heartbeat = Heartbeat(self._link, None, state, frozenset(faults))
        return self._health()

    def _health(self) -> Heartbeat | None:
        """Return the last heartbeat, completed by what other frames report."""
        if self.heartbeat is None:
            return None
        faults = self.heartbeat.faults | (set() if self._limits_sent else {'no_limits'})
        return replace(self.heartbeat, faults=faults, voltage=self._voltage,
                       temperature=self._temperature)

    # The link encodes.

    def report_wheel(self, message: messages.WheelReport) -> list[Frame]:
        return [self._estimates.encode({
            'Pos_Estimate': message.angle / tau, 'Vel_Estimate': (message.speed or 0.0) / tau})]

    def report_motor(self, message: messages.MotorReport) -> list[Frame]:
        return [self._torques.encode({
            'Torque_Target': message.torque, 'Torque_Estimate': message.torque})]

    def report_health(self, message: Heartbeat) -> list[Frame]:
        error = sum(bits[0] for fault, bits in _ERRORS.items() if fault in message.faults)
        if 'driver' in message.faults:
            error |= _DRIVER
        if message.state is LinkState.FAULT and not error:
            error = _SYSTEM_LEVEL
        error |= {LinkState.STOPPED: _ESTOP, LinkState.COASTING: _WATCHDOG}.get(message.state, 0)
        armed = message.state is LinkState.ARMED
        frames = [self._beat.encode({
            'Axis_Error': error, 'Axis_State': _CLOSED_LOOP if armed else _IDLE})]
        if message.voltage is not None:
            frames.append(self._bus.encode({'Bus_Voltage': message.voltage}))
        if message.temperature is not None:
            frames.append(self._temperatures.encode(
                dict.fromkeys(self._temperatures.signals, message.temperature)))
        return frames

    # The link decodes; arguments are signals of the file.

    def _decode_state(self, Axis_Requested_State: int) -> Command:
        if Axis_Requested_State not in (_IDLE, _CLOSED_LOOP):
            raise self._refusal(self._state, 'Axis_Requested_State', Axis_Requested_State,
                                (_IDLE, _CLOSED_LOOP))
        self._closed_loop = Axis_Requested_State == _CLOSED_LOOP
        return self._received_command()

    def _decode_mode(self, Control_Mode: int, Input_Mode: int) -> Command:
        modes = _TORQUE_CONTROL, _VELOCITY_CONTROL
        if Control_Mode not in modes:
            raise self._refusal(self._mode, 'Control_Mode', Control_Mode, modes)
        if Input_Mode != _PASSTHROUGH:
            raise self._refusal(self._mode, 'Input_Mode', Input_Mode, (_PASSTHROUGH,))
        self._by_speed = Control_Mode == _VELOCITY_CONTROL
        return self._received_command()

    def _decode_speed(self, Input_Vel: float) -> Command:
        self._speed = Input_Vel * tau
        return self._received_command()

    def _decode_torque(self, Input_Torque: float) -> Command:
        self._torque = Input_Torque
        return self._received_command()

    def _decode_limits(self, Velocity_Limit: float, Current_Limit: float
                       ) -> messages.Limits | None:
        if self._torque_constant is None:
            return None
        return messages.Limits(
            self._link, Current_Limit * self._torque_constant, Velocity_Limit * tau)

    def _received_command(self) -> Command:
        """Return the present input, mode and axis state as one command with its own sequence."""
        self._sequence = (self._sequence + 1) % 256
        return Command(self._link, self._speed if self._by_speed else self._torque,
                       self._by_speed, self._closed_loop, self._sequence)

    @staticmethod
    def _refusal(codec: MessageCodec, name: str, value: int, allowed: tuple[int, ...]
                 ) -> FrameError:
        return FrameError(
            'value', f'{codec.name}: {name} must be {" or ".join(map(str, allowed))}, got {value}',
            name=f'{codec.name}.{name}', value=value, limit=allowed)
