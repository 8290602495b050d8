# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Many motions of the links side by side, each under torques of its own that change every tick."""

from __future__ import annotations

from typing import Any

from fourbar_ros.kernels.compiler import kernel, prange
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.integration import move_held
from fourbar_ros.mechanism.state import LINK_RATES
import numpy as np
from numpy.typing import NDArray

# Link angles and rates come first in a state.
_LINKS = LINK_RATES.stop


def link_tracks(states: Array, torques: Array, chosen: NDArray[np.int64], factors: Array,
                step: float, steps: int, constants: NDArray[Any], around: NDArray[Any]) -> Array:
    """
    Integrate and keep the links at every tick, on all cores.

    Not for two threads at once.

    :param states: (n, STATE_SIZE) where each begins; not changed.
    :param torques: (k, m, 4) k sequences, held for a tick each, as in
        :func:`mechanism.motion.move_held`, over the factors.
    :param chosen: (n,) the sequence of each motion.
    :param factors: (n, 4) by which each multiplies it.
    :param step: [s].
    :param steps: in a tick.
    :param constants, around: (n,) of each motion.
    :returns: (m + 1, n, 8) link angles [rad] and rates [rad/s].
    """
    tracks = np.empty((torques.shape[1] + 1, len(states), _LINKS))
    _follow(np.array(states), np.ascontiguousarray(torques), chosen, factors, step, steps,
            constants, around, tracks)
    return tracks


@kernel(parallel=True)
def _follow(states: Array, torques: Array, chosen: NDArray[np.int64], factors: Array, step: float,
            steps: int, constants: NDArray[Any], around: NDArray[Any], tracks: Array) -> None:
    for index in prange(states.shape[0]):
        n = np.int64(index)
        state, held = states[n], np.empty(4)
        tracks[0, n] = state[:_LINKS]
        for tick in range(torques.shape[1]):
            for wheel in range(4):
                held[wheel] = factors[n, wheel] * torques[chosen[n], tick, wheel]
            move_held(state, held, step, steps, constants[n], around[n])
            tracks[tick + 1, n] = state[:_LINKS]
