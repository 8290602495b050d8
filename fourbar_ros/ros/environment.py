# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether there is a usable ROS 2 Jazzy, told before rclpy is imported.

rcl ends the process from inside the import where the middleware is the wrong one, so everything
is looked up without importing it.
"""

import ctypes
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
import os

from fourbar_ros.common.errors import FourbarError

# The first rclpy with the executor that the nodes run on.
OLDEST_RCLPY = (7, 1, 4)
LARGEST_DOMAIN = 232


class RosError(FourbarError):
    """ROS is missing, foreign, or refused what it was asked."""


def check_environment():
    """
    Refuse what would fail later with a message that nobody understands.

    :raises RosError: no or a foreign rclpy, unusable middleware, bad domain id.
    """
    spec = find_spec('rclpy')
    if spec is None:
        raise RosError('rclpy is missing: source a ROS 2 Jazzy installation, or make install')
    try:
        found = version('rclpy')
    except PackageNotFoundError:
        found = 'of unknown version'
    numbers = tuple(int(part) for part in found.split('.')[:3] if part.isdigit())
    if not OLDEST_RCLPY <= numbers < (OLDEST_RCLPY[0] + 1,):
        where = os.path.dirname(spec.origin or '')
        oldest = '.'.join(map(str, OLDEST_RCLPY))
        raise RosError(f'rclpy {found} in {where} is not that of ROS 2 Jazzy ({oldest} or a later '
                       f'{OLDEST_RCLPY[0]}): is another ROS sourced?')
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain and not (domain.isascii() and domain.isdigit() and int(domain) <= LARGEST_DOMAIN):
        raise RosError(f'ROS_DOMAIN_ID must be a whole number from 0 to {LARGEST_DOMAIN}, '
                       f'not {domain!r}')
    middleware = os.environ.get('RMW_IMPLEMENTATION', '')
    if middleware:
        try:
            ctypes.CDLL(f'lib{middleware}.so')
        except OSError:
            raise RosError(f'RMW_IMPLEMENTATION is {middleware!r}, which is not installed here: '
                           'unset it or install it') from None
