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

"""Four wheels meet what two axes need, with the least acceleration."""

from collections.abc import Callable
from math import pi

from fourbar_ros.control.allocation import minimum_norm
from fourbar_ros.control.reference import SoftStep
from fourbar_ros.mechanism import assemble, Mechanism, reduced_form
from fourbar_ros.plant import InitialState, Plant, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.linalg import null_space

Array = NDArray[np.float64]
SEEDS = range(20)
Draw = Callable[[int], tuple[Array, Array, Array]]


@pytest.fixture(scope='module')
def draw(uneven: Mechanism) -> Draw:
    """Draw a wheel map G of a linkage, wheel inertias and a demand."""
    def make(seed: int) -> tuple[Array, Array, Array]:
        rng = np.random.default_rng(seed)
        while True:
            phi_a, theta = rng.uniform(-pi, pi), rng.uniform(0.3, 2.0)
            angles = assemble(uneven, phi_a, phi_a + theta, str(rng.choice(['open', 'crossed'])))
            if abs(np.sin(angles[3] - angles[2])) > 0.2:
                break
        form = reduced_form(uneven, angles, np.zeros(2))
        return form.wheel_map, rng.uniform(1e-7, 1e-6, 4), rng.uniform(-1e-4, 1e-4, 2)
    return make


@pytest.mark.parametrize('seed', SEEDS)
def test_demand_is_met(seed: int, draw: Draw) -> None:
    """A du + b = -G tau; a condition number of 100 and a few roundings leave 1e-13."""
    wheel_map, inertias, demand = draw(seed)
    torques = minimum_norm(wheel_map, inertias, demand)
    np.testing.assert_allclose(-wheel_map @ torques, demand, rtol=0.0, atol=1e-13 * 1e-4 * 10)


@pytest.mark.parametrize('seed', SEEDS)
def test_any_other_answer_accelerates_the_wheels_more(seed: int, draw: Draw) -> None:
    wheel_map, inertias, demand = draw(seed)
    torques = minimum_norm(wheel_map, inertias, demand)
    least = np.linalg.norm(torques / inertias)
    free = null_space(wheel_map)
    assert free.shape == (4, 2)
    rng = np.random.default_rng(seed)
    for _ in range(50):
        other = torques + free @ rng.uniform(-1e-6, 1e-6, 2)
        assert np.linalg.norm(other / inertias) > least


@pytest.mark.parametrize('seed', SEEDS)
def test_null_space_only_loads_the_joints(seed: int, draw: Draw, uneven: Mechanism) -> None:
    """Torques with G tau = 0 turn the wheels, and no link moves, in the plant itself."""
    plant = Plant(uneven, Table(LinkSensorSettings(), WheelEncoders(0)),
                  InitialState(0.1 * seed, 0.1 * seed + 1.2), 5e-4, np.random.default_rng(0))
    angles = plant.truth().link_angles
    free = null_space(reduced_form(uneven, angles, np.zeros(2)).wheel_map)
    torques = free @ np.random.default_rng(seed).uniform(-5e-5, 5e-5, 2)
    plant.advance(1, torques)
    truth = plant.truth()
    np.testing.assert_allclose(
        truth.wheel_speeds, torques * 5e-4 / uneven.flywheel_inertias, rtol=1e-9, atol=1e-12)
    # The torques alone would give 1 rad/s^2 * 0.5 ms; what is left of that is rounding.
    assert np.abs(truth.link_rates).max() < 1e-14


def test_twins_of_the_rhombus_share_equally(paper: Mechanism) -> None:
    for theta in (0.4, pi / 3, pi / 2, 2.5):
        form = reduced_form(paper, assemble(paper, 0.3, 0.3 + theta), np.zeros(2))
        torques = minimum_norm(form.wheel_map, paper.flywheel_inertias, np.array([1e-5, -3e-6]))
        np.testing.assert_allclose(torques, [-5e-6, 1.5e-6, -5e-6, 1.5e-6], rtol=1e-12)


def test_bigger_wheel_of_a_pair_takes_the_square_of_its_share(paper: Mechanism) -> None:
    """Least accelerations s with If s1 + If s2 given are as If, so torques as If squared."""
    inertias = np.array([3e-7, 3e-7, 6e-7, 6e-7])
    form = reduced_form(paper, assemble(paper, 0.0, pi / 3), np.zeros(2))
    torques = minimum_norm(form.wheel_map, inertias, np.array([1e-5, 1e-5]))
    np.testing.assert_allclose(torques[2:] / torques[:2], [4.0, 4.0], rtol=1e-12)


def peak_speed(mechanism: Mechanism, wheels: int) -> tuple[float, float]:
    """
    Turn the rhombus by a quarter in 10 s from rest, with the wheels a, b or all four.

    :returns: peak absolute wheel speed [rad/s], peak energy of the wheels (paper eq. 7) [J].
    """
    start = np.array([[0.0, pi / 3], [0.0, 0.0], [0.0, 0.0]])
    step = SoftStep(start, start[0] + pi / 2, 10.0)
    inertias = mechanism.flywheel_inertias
    # Midpoints of 2 ms: the error is (h / 10 s)^2 of the speed.
    times = np.arange(1e-3, 10.0, 2e-3)
    speeds, peak, energy = np.zeros(4), 0.0, 0.0
    for time in times:
        angle, rate, acceleration = step.at(float(time))
        form = reduced_form(mechanism, assemble(mechanism, *angle), rate)
        demand = form.mass_matrix @ acceleration + form.bias
        torques = np.zeros(4)
        torques[:wheels] = minimum_norm(form.wheel_map[:, :wheels], inertias[:wheels], demand)
        speeds += torques / inertias * 2e-3
        peak = max(peak, float(np.abs(speeds).max()))
        energy = max(energy, 0.5 * float(inertias @ speeds ** 2))
    return peak, energy


@pytest.mark.parametrize(('wheels', 'speed', 'energy'), [
    (4, 62.37, 2.6452e-3), (2, 124.74, 5.2904e-3)])
def test_quarter_turn_of_the_paper(
    wheels: int, speed: float, energy: float, paper: Mechanism,
) -> None:
    """The numbers follow by hand from A = 1.44e-4 kg m^2 and the peak rate of the soft step."""
    assert peak_speed(paper, wheels) == (
        pytest.approx(speed, abs=0.005), pytest.approx(energy, abs=5e-8))
