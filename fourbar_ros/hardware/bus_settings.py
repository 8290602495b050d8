# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""How the prototype is reached: the parameters that host and emulator have in common."""

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
    """List the parameters of a bus; the arguments are defaults."""
    return (
        Setting('bus.interface', interface, '', 'interface of python-can, as socketcan, slcan, '
                  'serial, udp_multicast, virtual or fourbar_udp'),
        Setting('bus.channel', channel, '', 'channel of the interface, as can0 or HOST:PORT'),
        Setting('bus.bitrate', 1_000_000, 'bit/s', 'of interfaces that have one',
                  low=10_000, high=1_000_000),
        Setting('bus.options', options, '',
                  'more for the interface, as key=value, with spaces between'),
        Setting('codec', 'prototype', '', 'what is spoken on the bus', choices=CODECS),
        Setting('dbc', 'prototype', '', 'preset or path of the DBC file of what is not of '
                  'ODrive'),
    )


def open_bus(values: Mapping[str, Any]) -> Port:
    """
    Open the bus that parameters describe.

    :raises BusError: it cannot be.
    """
    return open_port(values['bus.interface'], values['bus.channel'], values['bus.bitrate'],
                     values['bus.options'])


def make_codec(values: Mapping[str, Any], mechanism: Mechanism) -> Codec:
    """
    Make the codec that parameters name.

    :param mechanism: whose motors ODrives limit by their currents.
    :raises FourbarError: the DBC file is not there or refused.
    """
    if values['codec'] == 'odrive':
        from fourbar_ros.hardware.odrive_codec import OdriveCodec
        return OdriveCodec(
            values['dbc'], torque_constants=mechanism.motor_torque_constants.tolist())
    from fourbar_ros.hardware.dbc_codec import DbcCodec
    return DbcCodec(values['dbc'])


def free_addresses(count: int) -> list[str]:
    """Find addresses on this machine, as channels, that nobody uses now."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                   for _ in range(count)]
        for one in sockets:
            one.bind(('127.0.0.1', 0))
        return [f'127.0.0.1:{one.getsockname()[1]}' for one in sockets]
