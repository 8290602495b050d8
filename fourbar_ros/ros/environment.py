# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Checks of the ROS environment and priorities of the process; imports no rclpy.

With the wrong middleware rcl ends the process while rclpy is imported, so the checks come first
and look everything up without importing it.
"""

from __future__ import annotations

import ctypes
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
import os

from fourbar_ros.common.errors import FourbarError

# First version of rclpy with the EventsExecutor.
OLDEST_RCLPY = (7, 1, 4)
# Largest domain id whose ports are below 65536.
LARGEST_DOMAIN = 232


class RosError(FourbarError):
    """ROS is missing, has the wrong version, or refused a request."""


def check_environment() -> None:
    """
    Refuse an environment in which rclpy would fail with an unclear message.

    :raises RosError: rclpy is missing or not of Jazzy, the middleware is not installed, or the
        domain id is out of range.
    """
    spec = find_spec('rclpy')
    if spec is None:
        raise RosError('rclpy is missing: source a ROS 2 Jazzy installation, or make install')
    try:
        installed = version('rclpy')
    except PackageNotFoundError:
        installed = 'of unknown version'
    parts = tuple(int(part) for part in installed.split('.')[:3] if part.isdigit())
    if not OLDEST_RCLPY <= parts < (OLDEST_RCLPY[0] + 1,):
        folder = os.path.dirname(spec.origin or '')
        oldest = '.'.join(map(str, OLDEST_RCLPY))
        raise RosError(
            f'rclpy {installed} in {folder} is not of ROS 2 Jazzy ({oldest} or a later '
            f'{OLDEST_RCLPY[0]}): is another ROS sourced?',
            name='rclpy', value=installed, limit=oldest)
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain and not (domain.isascii() and domain.isdigit() and int(domain) <= LARGEST_DOMAIN):
        raise RosError(
            f'ROS_DOMAIN_ID must be a whole number from 0 to {LARGEST_DOMAIN}, not {domain!r}',
            name='ROS_DOMAIN_ID', value=domain, limit=LARGEST_DOMAIN)
    middleware = os.environ.get('RMW_IMPLEMENTATION', '')
    if middleware:
        try:
            ctypes.CDLL(f'lib{middleware}.so')
        except OSError:
            raise RosError(
                f'RMW_IMPLEMENTATION is {middleware!r}, which is not installed here: unset it or '
                'install it', name='RMW_IMPLEMENTATION', value=middleware) from None


def set_realtime_priority(priority: int) -> None:
    """
    Give all threads of this process a real-time priority (SCHED_FIFO).

    :param priority: 1 to 99; every one is above all processes without one.
    :raises PermissionError: the user does not have it (limit `rtprio`); nothing changed.
    """
    for thread in os.listdir('/proc/self/task'):
        os.sched_setscheduler(
            int(thread), os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def lower_priority() -> None:
    """Lower the priority of a process that only records or monitors."""
    os.nice(5)
