# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Trajectories of several motions equal those of single motions."""

from fourbar_ros.mechanism import assemble, Mechanism
from fourbar_ros.mechanism.forces import NOTHING, surroundings
from fourbar_ros.mechanism.integration import link_trajectories, move_held
from fourbar_ros.mechanism.state import make_state
import numpy as np

STEP, STEPS = 1e-3, 4


def test_each_motion_has_the_bits_of_a_single_motion(paper: Mechanism, uneven: Mechanism) -> None:
    """The motions differ in linkages, surroundings, torques, factors and starts; seed 0."""
    generator = np.random.default_rng(0)
    mechanisms = [paper, uneven, paper]
    around = [NOTHING, surroundings(link_spin_drag=1e-6), surroundings(link_drag=1e-2)]
    torques = 1e-5 * generator.standard_normal((2, 25, 4))
    sequence = np.array([1, 0, 1])
    factors = generator.uniform(0.5, 2.0, (3, 4))
    states = np.array([make_state(assemble(mechanism, 0.1, 1.2)) for mechanism in mechanisms])
    trajectories = link_trajectories(
        states.copy(), torques, sequence, factors, STEP, STEPS,
        np.array([mechanism.constants for mechanism in mechanisms]), np.array(around))
    assert trajectories.shape == (26, 3, 8)
    for n, mechanism in enumerate(mechanisms):
        state = states[n].copy()
        np.testing.assert_array_equal(trajectories[0, n], state[:8])
        for tick in range(25):
            move_held(state, factors[n] * torques[sequence[n], tick], STEP, STEPS,
                      mechanism.constants, around[n])
            np.testing.assert_array_equal(
                trajectories[tick + 1, n], state[:8], err_msg=f'{n} {tick}')
