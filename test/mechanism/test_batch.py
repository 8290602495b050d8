# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Batches of motions have the same bytes as single motions."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from threading import Thread

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.forces import NOTHING, surroundings
from fourbar_ros.mechanism.integration import BatchError, move_batch, move_held
from fourbar_ros.mechanism.state import STATE_SIZE
import numba
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Mechanism]


@pytest.fixture
def campaign(random_linkage: Draw, random_state: Callable[..., Array]
             ) -> tuple[list[Mechanism], Array, Array]:
    """Draw nine linkages, their states and torques, seed 5."""
    rng = np.random.default_rng(5)
    linkages = [random_linkage(rng) for _ in range(9)]
    states = np.array([random_state(rng, linkage) for linkage in linkages])
    return linkages, states, rng.uniform(-0.1, 0.1, (9, 4))


@pytest.mark.parametrize('threads', [1, 2])
def test_batch_gives_the_bytes_of_single_motions(
    threads: int, campaign: tuple[list[Mechanism], Array, Array],
) -> None:
    """Each motion has its own constants and surroundings."""
    linkages, states, torques = campaign
    constants = np.array([linkage.constants for linkage in linkages])
    around = np.array([surroundings(joint_viscous=0.01 * n) for n in range(9)])
    alone = states.copy()
    for n in range(9):
        move_held(alone[n], torques[n], 1e-3, 200, linkages[n].constants, around[n])
    before = numba.get_num_threads()
    numba.set_num_threads(min(threads, before))
    try:
        move_batch(states, torques, 1e-3, 200, constants, around)
    finally:
        numba.set_num_threads(before)
    assert states.tobytes() == alone.tobytes()


def test_one_linkage_serves_all(campaign: tuple[list[Mechanism], Array, Array]) -> None:
    linkages, states, torques = campaign
    states[:] = states[0]
    alone = states[4].copy()
    move_held(alone, torques[4], 1e-3, 50, linkages[0].constants, NOTHING)
    move_batch(states, torques, 1e-3, 50, linkages[0].constants, NOTHING)
    assert states[4].tobytes() == alone.tobytes()


def test_batch_of_rigid_and_compliant_linkages_and_prescribed_wheels(
    campaign: tuple[list[Mechanism], Array, Array],
) -> None:
    """The constants of each row select its equations."""
    linkages, states, torques = campaign
    constants = np.array([
        replace(linkage, joint_stiffness=[1e3 * (n + 1)] * 4).constants if n % 3 == 0
        else linkage.constants_with(np.arange(4) < n % 3) for n, linkage in enumerate(linkages)])
    alone = states.copy()
    for n in range(9):
        move_held(alone[n], torques[n], 1e-3, 50, constants[n], NOTHING)
    move_batch(states, torques, 1e-3, 50, constants, NOTHING)
    assert states.tobytes() == alone.tobytes()


def test_batch_may_hold_one_state(campaign: tuple[list[Mechanism], Array, Array]) -> None:
    linkages, states, torques = campaign
    alone, one = states[0].copy(), states[:1].copy()
    move_held(alone, torques[0], 1e-3, 50, linkages[0].constants, NOTHING)
    move_batch(one, torques[:1], 1e-3, 50, linkages[0].constants, NOTHING)
    assert one.tobytes() == alone.tobytes()


def test_batches_of_two_threads_wait_for_each_other(
    campaign: tuple[list[Mechanism], Array, Array],
) -> None:
    """Each batch of concurrent threads has the right result."""
    linkages, states, torques = campaign
    constants = linkages[0].constants
    states[:] = states[0]
    alone = states.copy()
    for n in range(9):
        move_held(alone[n], torques[n], 1e-3, 100, constants, NOTHING)
    # Seven copies, so that each thread runs while the others start.
    parts = [np.repeat(states[[n]], 63, axis=0) for n in range(4)]
    loads = [np.tile(np.roll(torques, n, axis=0), (7, 1)) for n in range(4)]
    threads = [Thread(target=move_batch, args=(part, load, 1e-3, 100, constants, NOTHING))
               for part, load in zip(parts, loads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for n, part in enumerate(parts):
        assert part.tobytes() == np.tile(np.roll(alone, n, axis=0), (7, 1)).tobytes()


@pytest.mark.parametrize('made', [
    lambda states: np.repeat(states, 2, axis=0)[::2],
    np.asfortranarray, lambda states: states.astype(int),
    lambda states: states.astype(np.float32),
    lambda states: np.broadcast_to(states, states.shape)],
    ids=['rows', 'columns', 'integers', 'single', 'read-only'])
def test_states_of_another_layout_are_refused(
    made: Callable[[Array], Array], campaign: tuple[list[Mechanism], Array, Array],
    refuses: Callable[..., AbstractContextManager[None]],
) -> None:
    """A refused call changes no state."""
    linkages, states, torques = campaign
    given = made(states)
    before = given.copy()
    with refuses(BatchError, name='states', value=given.dtype):
        move_batch(given, torques, 1e-3, 10, linkages[0].constants, NOTHING)
    np.testing.assert_array_equal(given, before)


def test_torques_may_have_any_layout(campaign: tuple[list[Mechanism], Array, Array]) -> None:
    linkages, states, torques = campaign
    others = states.copy()
    move_batch(states, torques, 1e-3, 10, linkages[0].constants, NOTHING)
    move_batch(others, np.asfortranarray(torques), 1e-3, 10, linkages[0].constants, NOTHING)
    assert others.tobytes() == states.tobytes()


def test_empty_batch_is_allowed(campaign: tuple[list[Mechanism], Array, Array]) -> None:
    constants = campaign[0][0].constants
    move_batch(np.empty((0, STATE_SIZE)), np.empty((0, 4)), 1e-3, 1, constants, NOTHING)


@pytest.mark.parametrize(('states', 'torques', 'mechanisms', 'surrounded'), [
    ((3, STATE_SIZE - 1), (3, 4), 1, 1), ((STATE_SIZE,), (1, 4), 1, 1),
    ((1, 3, STATE_SIZE), (1, 4), 1, 1), ((3, STATE_SIZE), (2, 4), 1, 1),
    ((3, STATE_SIZE), (4,), 1, 1), ((3, STATE_SIZE), (3, 3), 1, 1),
    ((3, STATE_SIZE), (3, 4), 2, 1), ((3, STATE_SIZE), (3, 4), 4, 1),
    ((3, STATE_SIZE), (3, 4), 0, 1), ((3, STATE_SIZE), (3, 4), 1, 2)])
def test_wrong_shapes_are_refused(
    states: tuple[int, ...], torques: tuple[int, ...], mechanisms: int, surrounded: int,
    paper: Mechanism, refuses: Callable[..., AbstractContextManager[None]],
) -> None:
    constants = np.array([paper.constants] * 4)[:mechanisms]
    around = np.array([NOTHING] * 2)[:surrounded]
    before = np.zeros(states)
    with refuses(BatchError, value=(states, torques, mechanisms, surrounded)):
        move_batch(before, np.ones(torques), 1e-3, 1, constants, around)
    assert not before.any()
