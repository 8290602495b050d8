# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Accuracy of the linkage in MuJoCo, with its soft closure and held torques.

The error follows from the step h. Torques that are sampled in the middle of a step and held have a
relative error of (omega h)^2/24 at the frequency omega. Euler's method has an error of h/2 times
the rates. Joint 3 is compliant, least with the stiffest settings.
"""

from collections.abc import Callable
from dataclasses import replace
import json
from pathlib import Path
from typing import Any

from fourbar_ros.mechanism import (
    angular_momentum,
    assemble,
    kinetic_energy,
    Mechanism,
    reduced_form,
)
from fourbar_ros.studies.independent.mujoco_model import (
    MujocoError,
    MujocoLinkage,
    Settings,
    State,
    stiff,
)
import numpy as np
import pytest

CASES = sorted((Path(__file__).parents[2] / 'config' / 'reference').glob('*.json'))
STEP = 1e-3
QUANTITIES = ('link_angles', 'link_rates', 'flywheel_speeds_absolute')

each_case = pytest.mark.parametrize('path', CASES, ids=lambda path: path.stem)


@pytest.fixture(autouse=True)
def mujoco() -> None:
    """Skip the test where MuJoCo is not installed."""
    pytest.importorskip('mujoco')


class Reference:
    """A reference motion from a file."""

    def __init__(self, path: Path) -> None:
        values: dict[str, Any] = json.loads(path.read_text())
        initial, torque = values['initial'], values['motor_torque']
        self.mechanism = Mechanism.from_mapping(values['mechanism'], path.name)
        self.start = state_of(self.mechanism, *(initial[name] for name in QUANTITIES))
        self.times = np.array(values['t'])
        self.expected = {name: np.array(values[name]) for name in QUANTITIES}
        self.amplitude = np.array(torque['amplitude'])
        self.omega = 2.0 * np.pi * np.array(torque['frequency_hz'])
        self.phase = np.array(torque['phase'])

    def torques_at(self, time: float) -> Any:
        return self.amplitude * np.cos(self.omega * time + self.phase)

    def move(self, settings: Settings, until: float, sampled: float = 0.5) -> State:
        times = self.times[self.times <= until + 1e-9]
        return MujocoLinkage(self.mechanism, settings).move(
            self.start, times, self.torques_at, sampled)

    def error(self, state: State, name: str = 'link_angles') -> float:
        values = getattr(state, name)
        return float(np.abs(values - self.expected[name][:len(values)]).max())


def state_of(mechanism: Mechanism, angles: Any, rates: Any, wheel_speeds: Any) -> State:
    zeros = np.zeros(4)
    return State(np.array(angles), np.array(rates), zeros, np.array(wheel_speeds), zeros[:2],
                 zeros[:2])


def moving_state(mechanism: Mechanism, rng: np.random.Generator) -> State:
    """Return a random state on the closure, some turns away from zero."""
    angles = assemble(mechanism, *rng.uniform(0.3, 1.0, 2) * [1.0, 2.0])
    rates = rng.normal(size=2)
    rates = np.append(rates, reduced_form(mechanism, angles, rates).gamma @ rates)
    return State(angles + 2.0 * np.pi * rng.integers(-3, 4, 4), rates,
                 rng.normal(scale=100.0, size=4), rng.normal(scale=100.0, size=4),
                 rng.normal(size=2), rng.normal(size=2))


def reference_named(name: str) -> Reference:
    return Reference(next(path for path in CASES if path.stem == name))


def test_state_that_is_set_is_returned(uneven: Mechanism) -> None:
    rng = np.random.default_rng(1)
    linkage = MujocoLinkage(uneven)
    for _ in range(20):
        state = moving_state(uneven, rng)
        linkage.set_state(state)
        found = linkage.state()
        for name, value in vars(state).items():
            np.testing.assert_allclose(getattr(found, name), value, rtol=1e-13, atol=1e-13,
                                       err_msg=name)
        assert linkage.gap() < 1e-15


def test_momentum_and_energy_are_those_of_the_mechanism(uneven: Mechanism) -> None:
    """The sums depend on masses, inertias, lengths and offsets of the model."""
    import mujoco

    rng = np.random.default_rng(2)
    linkage = MujocoLinkage(uneven)
    for _ in range(20):
        state = moving_state(uneven, rng)
        linkage.set_state(state)
        mujoco.mj_forward(linkage.model, linkage.data)
        mujoco.mj_energyVel(linkage.model, linkage.data)
        mujoco.mj_subtreeVel(linkage.model, linkage.data)
        motion = (uneven, state.link_angles, state.link_rates, state.flywheel_speeds_absolute)
        drift = 0.5 * uneven.link_masses.sum() * state.centre_velocity @ state.centre_velocity
        assert linkage.data.energy[1] == pytest.approx(kinetic_energy(*motion) + drift, rel=1e-12)
        assert linkage.data.subtree_angmom[0, 2] == pytest.approx(
            angular_momentum(*motion), rel=1e-10)


@pytest.mark.medium
@each_case
def test_stiff_closure_has_the_error_of_the_held_torque(path: Path) -> None:
    reference = Reference(path)
    state = reference.move(stiff('RK4', STEP), reference.times[-1])
    # The tolerance has 1 % for the compliant joint and 1e-12 for the digits of the file.
    share = 1.01 * (reference.omega.max() * STEP) ** 2 / 24.0
    for name in QUANTITIES:
        most = np.abs(reference.expected[name]).max()
        assert reference.error(state, name) <= share * most + 1e-12, name
    # There is no external force.
    assert np.abs(state.centre_position).max() < 1e-11


@pytest.mark.medium
@each_case
def test_error_of_euler_is_half_a_step(path: Path) -> None:
    reference = Reference(path)
    state = reference.move(stiff('Euler', STEP), 4.0)
    travelled = np.abs(reference.expected['link_rates'][:81]).max()
    assert 0.1 * STEP * travelled < reference.error(state) <= STEP * travelled


@pytest.mark.medium
@each_case
def test_default_closure_is_compliant(path: Path) -> None:
    """The default closure of MuJoCo, 20 ms, has errors between 1e-8 and 1e-4 rad."""
    reference = Reference(path)
    soft = reference.error(reference.move(Settings('RK4', STEP), 4.0))
    hard = reference.error(reference.move(stiff('RK4', STEP), 4.0))
    assert 10.0 * hard < soft < 1e-4


@pytest.mark.medium
@pytest.mark.parametrize(('integrator', 'order'), [('Euler', 1), ('RK4', 2)])
def test_error_shrinks_with_the_step(integrator: str, order: int) -> None:
    """With RK4 only the held torque contributes, which is of second order."""
    reference = reference_named('asymmetric')
    coarse, fine = (reference.error(reference.move(stiff(integrator, step), 4.0))
                    for step in (2e-3, 1e-3))
    assert coarse / fine == pytest.approx(2.0 ** order, rel=0.1)


@pytest.mark.parametrize('sampled', [0.0, 0.5])
@pytest.mark.parametrize('integrator', ['Euler', 'RK4'])
def test_torque_is_held_from_its_sampling_time(integrator: str, sampled: float) -> None:
    """The momentum of a wheel is the sum of its torques, for any motion of the links."""
    reference = reference_named('asymmetric')
    state = reference.move(stiff(integrator, STEP), 0.5, sampled)
    moments = (np.arange(500) + sampled) * STEP
    given = sum(reference.torques_at(moment) for moment in moments) * STEP
    # The tolerance is for the mass of the wheel at the mass centre of its link.
    np.testing.assert_allclose(
        reference.mechanism.flywheel_inertias * state.flywheel_speeds_absolute[-1], given,
        rtol=1e-9)


def test_momentum_is_conserved(uneven: Mechanism) -> None:
    """Closure and motor torques are internal, for a drifting linkage with motors at limits."""
    state = moving_state(uneven, np.random.default_rng(3))
    times = np.array([0.0, 0.1, 0.2])
    moved = MujocoLinkage(uneven, stiff('RK4', STEP)).move(
        state, times, lambda time: 1e-4 * np.array([1.0, -1.0, 1.0, -0.5]))
    momenta = [angular_momentum(uneven, *motion) for motion in zip(
        moved.link_angles, moved.link_rates, moved.flywheel_speeds_absolute)]
    assert np.ptp(momenta) < 1e-9 * np.abs(
        uneven.flywheel_inertias * moved.flywheel_speeds_absolute[-1]).sum()
    np.testing.assert_allclose(
        moved.centre_position, state.centre_position + np.outer(times, state.centre_velocity),
        rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(moved.centre_velocity, [state.centre_velocity] * 3, rtol=0.0,
                               atol=1e-10)


def test_locked_wheel_follows_its_law(paper: Mechanism) -> None:
    """
    Wheels a and c turn by 100 (cos(2 pi f t) - 1) relative to their links, as in the paper.

    A pair of links has A = 1.44e-4 kg m^2 in the rhombus, and the momentum of pair and wheels is
    zero: (A + 2 If) phi' + 2 If psi' = 0. Links b and d are at rest.
    """
    omega, amplitude = 2.0 * np.pi * 0.1, 100.0
    inertia = paper.flywheel_inertias[0]
    angles = assemble(paper, 0.0, np.pi / 3.0)
    linkage = MujocoLinkage(paper, stiff('RK4', STEP), [True] * 4)
    times = np.linspace(0.0, 2.0, 11)
    state = linkage.move(
        state_of(paper, angles, np.zeros(4), np.zeros(4)), times,
        lambda time: -inertia * omega ** 2 * amplitude * np.cos(omega * time)
        * np.array([1.0, 0.0, 1.0, 0.0]), sampled=0.5)
    turned = -2.0 * inertia * amplitude * (np.cos(omega * times) - 1.0) / (1.44e-4 + 2.0 * inertia)
    expected = np.outer(turned, [1.0, 0.0, 1.0, 0.0])
    share = (omega * STEP) ** 2 / 24.0
    np.testing.assert_allclose(state.link_angles - angles, expected, rtol=0.0,
                               atol=2.0 * share * np.abs(turned).max())
    np.testing.assert_array_equal(state.flywheel_speeds_absolute, state.link_rates)


def test_wheels_locked_to_the_law_of_free_ones_give_the_same_motion() -> None:
    """The law of the locked wheels is the motion of a run with free wheels."""
    reference = reference_named('asymmetric')
    mechanism, times = reference.mechanism, np.arange(0.0, 0.5, STEP)
    free = reference.move(stiff('RK4', STEP), 0.5)
    run = MujocoLinkage(mechanism, stiff('RK4', STEP)).move(
        reference.start, times, reference.torques_at, sampled=0.5)
    # The relative acceleration of wheels a and c is the absolute one minus that of the link.
    link = np.gradient(run.link_rates, times, axis=0, edge_order=2)
    locked = np.array([True, False, True, False])

    def torques_at(time: float) -> Any:
        acceleration = [np.interp(time, times, column) for column in link.T]
        return reference.torques_at(time) - locked * mechanism.flywheel_inertias * acceleration

    mixed = MujocoLinkage(mechanism, stiff('RK4', STEP), locked).move(
        reference.start, reference.times[:10], torques_at, sampled=0.5)
    np.testing.assert_allclose(mixed.link_angles, free.link_angles[:10], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(mixed.flywheel_speeds_absolute[:, ~locked],
                               free.flywheel_speeds_absolute[:10, ~locked], rtol=1e-9)


def test_lean_step_equals_the_full_step() -> None:
    reference = reference_named('asymmetric')
    settings = stiff('RK4', STEP)
    np.testing.assert_allclose(
        reference.move(replace(settings, lean=True), 0.5).link_angles,
        reference.move(settings, 0.5).link_angles, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize(('make', 'name', 'value'), [
    (lambda: Settings('Runge'), 'integrator', 'Runge'),
    (lambda: Settings('Euler', 0.0), 'timestep', 0.0),
    (lambda: stiff('Euler', float('inf')), 'timestep', float('inf')),
    (lambda: stiff('Euler', float('nan')), 'timestep', pytest.approx(float('nan'), nan_ok=True)),
])
def test_impossible_settings(make: Callable[[], Settings], name: str, value: Any, refuses: Any
                             ) -> None:
    with refuses(MujocoError, name=name, value=value):
        make()


@pytest.mark.parametrize('times', [[0.0, 0.0015], [0.0, 0.0], [0.002, 0.001]])
def test_times_between_the_steps(times: list[float], paper: Mechanism, refuses: Any) -> None:
    state = state_of(paper, assemble(paper, 0.0, 1.0), np.zeros(4), np.zeros(4))
    with refuses(MujocoError, name='times', limit=STEP):
        MujocoLinkage(paper, stiff('Euler', STEP)).move(
            state, np.array(times), lambda time: np.zeros(4))


def test_motion_that_diverges(
    paper: Mechanism, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refuses: Any,
) -> None:
    monkeypatch.chdir(tmp_path)     # MuJoCo writes its log there
    state = state_of(paper, assemble(paper, 0.0, 1.0), np.zeros(4), np.zeros(4))
    with refuses(MujocoError, value=0.05):
        MujocoLinkage(paper, Settings('Euler', 0.05)).move(
            state, np.arange(20) * 0.05, lambda time: np.array([1e3, -1e3, 0.0, 0.0]))
