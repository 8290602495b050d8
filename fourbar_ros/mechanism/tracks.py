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

"""Many motions of the links side by side, each under torques of its own that change every tick."""

from __future__ import annotations

from typing import Any

from fourbar_ros.mechanism.compiled import kernel, prange
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.layout import LINK_RATES
from fourbar_ros.mechanism.motion import move_held
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
