# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Whether there is a usable ROS 2 Jazzy, told before rclpy is imported.

rcl ends the process from inside the import where the middleware is the wrong one, so everything
is looked up without importing it.
"""

import ctypes
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
import os

from fourbar_ros.errors import FourbarError

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
