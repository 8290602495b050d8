# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the bus and its protocol, common to host and emulator."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
import socket
from typing import Any

from fourbar_ros.common.settings import Setting
from fourbar_ros.hardware.can_port import open_port, Port
from fourbar_ros.hardware.messages import Codec
from fourbar_ros.mechanism import Mechanism

CODECS = ('prototype', 'odrive')


def bus_parameters(interface: str, channel: str, options: str) -> tuple[Setting, ...]:
    """Return the declarations of the parameters; the arguments are defaults."""
    return (
        Setting('bus.interface', interface, '', 'interface of python-can, as socketcan, slcan, '
                'serial, udp_multicast, virtual or fourbar_udp'),
        Setting('bus.channel', channel, '', 'channel of the interface, as can0 or HOST:PORT'),
        Setting('bus.bitrate', 1_000_000, 'bit/s', 'bit rate, for interfaces that have one',
                low=10_000, high=1_000_000),
        Setting('bus.options', options, '',
                'further options of the interface, as key=value, separated by spaces'),
        Setting('codec', 'prototype', '', 'protocol on the bus', choices=CODECS),
        Setting('dbc', 'prototype', '', 'preset or path of the DBC file of the messages of the '
                'prototype'),
    )


def open_bus(values: Mapping[str, Any]) -> Port:
    """
    Open the bus that the parameters describe.

    :raises BusError: the bus cannot be opened.
    """
    return open_port(values['bus.interface'], values['bus.channel'], values['bus.bitrate'],
                     values['bus.options'])


def make_codec(values: Mapping[str, Any], mechanism: Mechanism) -> Codec:
    """
    Return the codec that the parameters name.

    :param mechanism: has the torque constants, which ODrives need.
    :raises FourbarError: the DBC file is missing or refused.
    """
    if values['codec'] == 'odrive':
        from fourbar_ros.hardware.odrive_codec import OdriveCodec
        return OdriveCodec(
            values['dbc'], torque_constants=mechanism.motor_torque_constants.tolist())
    from fourbar_ros.hardware.dbc_codec import DbcCodec
    return DbcCodec(values['dbc'])


def free_addresses(count: int) -> list[str]:
    """Return unused UDP addresses of this machine, as channels."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                   for _ in range(count)]
        for each in sockets:
            each.bind(('127.0.0.1', 0))
        return [f'127.0.0.1:{each.getsockname()[1]}' for each in sockets]
