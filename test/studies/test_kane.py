# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The derivation by Kane's method: reference motions, conservation, prescribed wheels."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
import json
from pathlib import Path
from typing import Any

from fourbar_ros.mechanism import assemble, Mechanism, reduced_form
from fourbar_ros.mechanism.case import Case, load_case
from fourbar_ros.studies.independent import kane
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Refuses = Callable[..., AbstractContextManager[None]]
Conserved = Callable[[Case], tuple[Array, Array]]

REFERENCE = Path(__file__).parents[2] / 'config' / 'reference'
ZERO = np.zeros(4)
FREE = np.zeros(4, dtype=bool)
PRESCRIBED = np.ones(4, dtype=bool)


@pytest.fixture(autouse=True)
def sympy() -> None:
    """Skip the test where SymPy is not installed."""
    pytest.importorskip('sympy')


@pytest.fixture(scope='module')
def conserved(momentum_and_energy: Callable[..., tuple[float, float]]
              ) -> Callable[[Case], tuple[Array, Array]]:
    """Return a function that gives momentum and energy (n,) along the motion of a case."""
    def along(case: Case) -> tuple[Array, Array]:
        motion = kane.simulate(case)
        momentum, energy = np.array([momentum_and_energy(case.mechanism, *state) for state in zip(
            motion.link_angles, motion.link_rates, motion.flywheel_speeds_absolute)]).T
        return momentum, energy

    return along


@pytest.fixture(scope='module')
def moving(uneven: Mechanism) -> Case:
    """Return the case of a moving linkage without equal parameters, with coasting wheels."""
    angles = assemble(uneven, 0.2, 1.3)
    across = np.stack([-np.sin(angles), np.cos(angles)]) * uneven.link_lengths * [-1, 1, 1, -1]
    rates = np.array([0.4, 0.1])
    dependent = np.linalg.solve(across[:, 2:], -across[:, :2] @ rates)
    return Case(
        mechanism=uneven, link_angles=angles, link_rates=np.concatenate([rates, dependent]),
        flywheel_speeds_absolute=np.array([20.0, -30.0, 5.0, 0.0]), amplitude=ZERO,
        frequency_hz=np.array([0.4, 0.3, 0.2, 0.5]), phase=np.array([0.3, -0.5, 1.0, 2.0]),
        times=np.linspace(0.0, 2.0, 21), prescribed=FREE)


@pytest.mark.medium
@pytest.mark.parametrize('name', [
    'asymmetric', 'paper_all', 'paper_pair_ac', 'parallelogram_offset_spinning'])
def test_reference_motions(name: str) -> None:
    """The files have at least ten decimals."""
    path = REFERENCE / f'{name}.json'
    reference: dict[str, Any] = json.loads(path.read_text())
    motion = kane.simulate(load_case(path))
    np.testing.assert_array_equal(motion.times, reference['t'])
    for values, expected in (
            (motion.link_angles, 'link_angles'), (motion.link_rates, 'link_rates'),
            (motion.flywheel_speeds_absolute, 'flywheel_speeds_absolute')):
        np.testing.assert_allclose(values, reference[expected], rtol=1e-10, atol=1e-10)


def test_wheels_without_torque_conserve_momentum_and_energy(
    moving: Case, conserved: Conserved,
) -> None:
    momentum, energy = conserved(moving)
    np.testing.assert_allclose(momentum, momentum[0], rtol=1e-11)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-11)
    speeds = kane.simulate(moving).flywheel_speeds_absolute
    np.testing.assert_allclose(
        speeds, np.broadcast_to(speeds[0], speeds.shape), rtol=0.0, atol=1e-10)


@pytest.mark.medium
def test_wheels_locked_to_their_links_conserve_momentum_and_energy(
    moving: Case, conserved: Conserved,
) -> None:
    locked = replace(moving, prescribed=PRESCRIBED, flywheel_speeds_absolute=moving.link_rates)
    momentum, energy = conserved(locked)
    np.testing.assert_allclose(momentum, momentum[0], rtol=1e-11)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-11)


@pytest.mark.medium
def test_mixed_wheels_conserve_momentum_and_follow_their_laws(
    moving: Case, conserved: Conserved,
) -> None:
    """Wheels a and d are prescribed, b and c driven; motor torques are internal."""
    prescribed = np.array([True, False, False, True])
    mixed = replace(moving, amplitude=np.array([9.0, 3e-5, -2e-5, 6.0]), prescribed=prescribed)
    motion = kane.simulate(mixed)
    momentum, energy = conserved(mixed)
    # The momenta of links and wheels almost cancel.
    scale = float((np.abs(motion.flywheel_speeds_absolute)
                   @ moving.mechanism.flywheel_inertias).max())
    np.testing.assert_allclose(momentum, momentum[0], rtol=0.0, atol=1e-11 * scale)
    assert np.ptp(energy) > 0.1 * energy[0]

    times = mixed.times[:, np.newaxis]
    turn = 2.0 * np.pi * mixed.frequency_hz
    relative = motion.flywheel_speeds_absolute - motion.link_rates
    given = -turn * mixed.amplitude * np.sin(turn * times + mixed.phase)
    np.testing.assert_allclose(relative[:, prescribed], given[:, prescribed], atol=1e-12)
    # The law is If d(omega_f)/dt = tau, independent of the link.
    gained = mixed.amplitude / turn * (np.sin(turn * times + mixed.phase) - np.sin(mixed.phase))
    expected = mixed.flywheel_speeds_absolute + gained / moving.mechanism.flywheel_inertias
    np.testing.assert_allclose(motion.flywheel_speeds_absolute[:, ~prescribed],
                               expected[:, ~prescribed], rtol=0.0, atol=1e-10)


def test_closure_is_conserved(moving: Case) -> None:
    motion = kane.simulate(replace(moving, amplitude=np.full(4, 3e-5)))
    assert np.ptp(motion.link_angles, axis=0).min() > 0.1
    assert motion.closure_error.max() < 1e-13
    lengths = moving.mechanism.link_lengths * [-1, 1, 1, -1]
    gap = np.hypot(np.cos(motion.link_angles) @ lengths, np.sin(motion.link_angles) @ lengths)
    np.testing.assert_allclose(motion.closure_error, gap, rtol=0.0, atol=1e-15)


@pytest.mark.medium
def test_torque_of_a_prescribed_wheel_gives_the_same_motion(paper: Mechanism) -> None:
    """
    Wheels a and c of a rhombus at rest are prescribed, or driven by the equivalent torque.

    The pair has inertia J = 2 I + m l^2 / 2, and J omega + 2 If (omega + dpsi/dt) = 0. The torque
    is If d(omega + dpsi/dt)/dt = If (1 - k) d2psi/dt2 with k = 2 If / (J + 2 If).
    """
    wheel = float(paper.flywheel_inertias[0])
    inertia = 2.0 * 2.2e-5 + 0.02 * 0.1**2 / 2.0
    turn = 2.0 * np.pi * 0.25
    case = Case(
        mechanism=paper, link_angles=np.array([0.0, 1.0, 0.0, 1.0]), link_rates=ZERO,
        flywheel_speeds_absolute=ZERO, amplitude=np.array([80.0, 0.0, 80.0, 0.0]),
        frequency_hz=np.full(4, 0.25), phase=ZERO, times=np.linspace(0.0, 3.0, 31),
        prescribed=PRESCRIBED)
    torque = -wheel * inertia / (inertia + 2.0 * wheel) * turn**2 * case.amplitude
    by_angle = kane.simulate(case)
    by_torque = kane.simulate(replace(case, amplitude=torque, prescribed=FREE))
    np.testing.assert_allclose(by_angle.link_angles, by_torque.link_angles, rtol=0, atol=1e-11)
    np.testing.assert_allclose(
        by_angle.flywheel_speeds_absolute, by_torque.flywheel_speeds_absolute, rtol=0, atol=1e-9)
    assert np.ptp(by_angle.link_angles[:, 0]) > 0.5


def test_start_on_a_change_point_is_refused(paper: Mechanism, refuses: Refuses) -> None:
    case = Case(
        mechanism=paper, link_angles=ZERO, link_rates=np.array([0.5, -0.5, 0.5, -0.5]),
        flywheel_speeds_absolute=ZERO, amplitude=ZERO, frequency_hz=ZERO, phase=ZERO,
        times=np.linspace(0.0, 0.6, 7), prescribed=FREE)
    with refuses(kane.KaneError, time=0.0):
        kane.simulate(case)


@pytest.mark.slow
def test_motion_into_a_line_of_links_ends(uneven: Mechanism) -> None:
    """Links c and d of a kite meet a and b, where the step size goes to zero."""
    kite = replace(uneven, link_lengths=np.array([0.1, 0.1, 0.12, 0.12]))
    angles = assemble(kite, 0.0, 0.05)
    rates = np.array([0.0, -1.0])
    dependent = reduced_form(kite, angles, rates).gamma @ rates
    case = Case(
        mechanism=kite, link_angles=angles, link_rates=np.concatenate([rates, dependent]),
        flywheel_speeds_absolute=ZERO, amplitude=ZERO, frequency_hz=ZERO, phase=ZERO,
        times=np.linspace(0.0, 0.2, 5), prescribed=FREE)
    with pytest.raises(kane.KaneError) as caught:
        kane.simulate(case)
    # The links are collinear after 0.05 s.
    assert 0.0 < caught.value.values['time'] < 0.1
