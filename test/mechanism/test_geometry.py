# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Positions of joints and mass centres in the frame of the whole."""

from collections.abc import Callable

from fourbar_ros.mechanism import com_positions_in_table, joint_positions, Mechanism
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Mechanism]

SEEDS = range(20)
# Joints as indices, (from, to) of the links a, b, c, d.
ENDS = ((0, 3), (0, 1), (1, 2), (3, 2))
# Rounding of a few numbers of about 1 m.
ROUNDING = 1e-14


@pytest.mark.parametrize('seed', SEEDS)
def test_distance_of_joints_is_the_link_length(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    joints = joint_positions(linkage, random_state(rng, linkage)[:4])
    distances = [np.linalg.norm(joints[end] - joints[start]) for start, end in ENDS]
    np.testing.assert_allclose(distances, linkage.link_lengths, rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize('seed', SEEDS)
def test_link_points_along_its_angle(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    angles = random_state(rng, linkage)[:4]
    joints = joint_positions(linkage, angles) @ [1.0, 1j]
    directions = [(joints[end] - joints[start]) / length
                  for (start, end), length in zip(ENDS, linkage.link_lengths)]
    np.testing.assert_allclose(directions, np.exp(1j * angles), rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize('seed', SEEDS)
def test_mass_centre_of_the_whole_is_the_origin(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    centres = com_positions_in_table(linkage, random_state(rng, linkage)[:4])
    np.testing.assert_allclose(
        linkage.link_masses @ centres / linkage.link_masses.sum(), 0.0, rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize('seed', SEEDS)
def test_mass_centre_in_its_link_is_that_of_the_parameters(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    angles = random_state(rng, linkage)[:4]
    joints = joint_positions(linkage, angles) @ [1.0, 1j]
    centres = com_positions_in_table(linkage, angles) @ [1.0, 1j]
    near = joints[[start for start, _ in ENDS]]
    np.testing.assert_allclose(
        (centres - near) * np.exp(-1j * angles), linkage.com_positions @ [1.0, 1j], rtol=0.0,
        atol=ROUNDING)


@pytest.mark.parametrize('place', [joint_positions, com_positions_in_table])
def test_array_of_poses_equals_single_poses(
    place: Callable[..., Array], random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(0)
    linkage = random_linkage(rng)
    poses = np.array([[random_state(rng, linkage)[:4] for _ in range(3)] for _ in range(2)])
    together = place(linkage, poses)
    assert together.shape == (2, 3, 4, 2)
    np.testing.assert_allclose(
        together[1, 2], place(linkage, poses[1, 2]), rtol=0.0, atol=ROUNDING)
