# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What sensors report about the links, and what is true; plant and device share these types."""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.mechanism.constants import Array


@dataclass(frozen=True, eq=False)
class LinkSample:
    """
    Samples of link-angle sensors that were measured at one instant.

    :param stamp_ns: time of measurement [ns].
    :param names: sensors that have a sample, in the order of the device's `sensor_names`.
    :param angles: (n,) orientation of each link in frame `table`, or of a joint's second link
        relative to its first, in (-pi, pi] [rad].
    :param rates: (n,) angular rates [rad/s], or (0,) without gyros.
    """

    stamp_ns: int
    names: tuple[str, ...]
    angles: Array
    rates: Array


@dataclass(frozen=True, eq=False)
class TrueState:
    """
    The state of a simulated device without sensors and their errors.

    :param link_angles: (4,) continuous [rad].
    :param link_rates: (4,) [rad/s].
    :param wheel_angles: (4,) relative to the link, unwrapped [rad].
    :param wheel_speeds: (4,) relative to the link [rad/s].
    :param efforts: (4,) torque of each motor, mean over the last control period [N m].
    :param random_walk_torques: (2,) random-walk torques on links a and b in that period [N m].
    :param centre_position: (2,) centre of mass of the whole in frame `table` [m].
    :param centre_velocity: (2,) [m/s].
    :param base_position: (2,) joint 1, the origin of the frame of link a [m].
    :param base_velocity: (2,) [m/s].
    """

    link_angles: Array
    link_rates: Array
    wheel_angles: Array
    wheel_speeds: Array
    efforts: Array
    random_walk_torques: Array
    centre_position: Array
    centre_velocity: Array
    base_position: Array
    base_velocity: Array
