# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Manoeuvres, momentum and arming of the closed loop."""

from collections.abc import Callable
from math import pi

from fourbar_ros.control import Controller, ControllerSettings
from fourbar_ros.control.actuation_cost_sums import FLYWHEEL_ENERGY
from fourbar_ros.device import DeviceState, DeviceSupervisor, SupervisorSettings
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.estimation import Estimator, EstimatorSettings
from fourbar_ros.loop import ClosedLoop, Step
from fourbar_ros.mechanism import angular_momentum, branch_of, load_mechanism, Mechanism
from fourbar_ros.plant import InitialState, load_table, Plant
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
MakeLoop = Callable[..., ClosedLoop]

PERIOD_NS = 4_000_000
HALF_A_DEGREE = pi / 360.0
# Peak rate of the soft step times A = 1.44e-4 kg m^2, by two wheels of 3.4e-7 kg m^2 [rad/s].
PEAK = 62.37


@pytest.fixture(scope='module')
def uneven() -> Mechanism:
    """Make a linkage without equal parameters."""
    return Mechanism(  # type: ignore[arg-type]
        [0.12, 0.08, 0.11, 0.10], [0.02, 0.03, 0.025, 0.018], [2.2e-5, 1.5e-5, 3e-5, 1.8e-5],
        [[0.05, 0.01], [0.04, -0.01], [0.06, 0.005], [0.05, 0.0]], [3e-7, 4e-7, 5e-7, 2e-7],
        [1e-4] * 4, [500.0] * 4)


@pytest.fixture(scope='module')
def make_loop() -> MakeLoop:
    """Return a function that makes a loop of the presets, armed and settled for 0.4 s."""
    def make(mechanism: Mechanism | None = None, phi_b: float = pi / 3, branch: str = 'open',
             seed: int = 0, settled: bool = True) -> ClosedLoop:
        linkage = load_mechanism('paper') if mechanism is None else mechanism
        plant = Plant(linkage, load_table('ideal'), InitialState(0.0, phi_b, branch), 5e-4,
                      np.random.default_rng(seed))
        loop = ClosedLoop(
            DeviceSupervisor(SimulatedTable(plant, PERIOD_NS), SupervisorSettings()),
            Estimator(linkage, EstimatorSettings()), Controller(linkage, ControllerSettings()))
        if settled:
            for _ in range(100):
                loop.step()
            assert loop.arm() == (True, 'armed')
            loop.step()
        return loop
    return make


def absolute_speeds(step: Step) -> Array:
    truth = step.samples.truth
    assert truth is not None
    return truth.wheel_speeds + truth.link_rates


def tracking(steps: list[Step]) -> Array:
    """Return reference minus true angles (n, 4) [rad]."""
    errors = []
    for step in steps:
        assert step.control is not None
        assert step.samples.truth is not None
        errors.append(step.control.reference_angles - step.samples.truth.link_angles)
    wrapped: Array = np.angle(np.exp(1j * np.array(errors)))
    return wrapped


def quarter_turn(loop: ClosedLoop, change: float = 0.0) -> list[Step]:
    """Turn links a and b by 90 degrees, b by `change` more, and wait one second longer."""
    before = loop.step().estimate
    assert before is not None
    loop.controller.setpoint(['link_a', 'link_b'], [
        before.link_angles[0] + pi / 2, before.link_angles[1] + pi / 2 + change])
    return [loop.step() for _ in range(2750)]


def check_tracking(loop: ClosedLoop, steps: list[Step]) -> None:
    errors = tracking(steps)
    assert np.sqrt((errors ** 2).mean(axis=0)).max() <= HALF_A_DEGREE
    assert np.abs(errors[-1]).max() <= HALF_A_DEGREE
    assert steps[-1].samples.truth is not None
    turned = steps[-1].samples.truth.link_angles[0] - steps[0].samples.truth.link_angles[0]
    assert turned == pytest.approx(pi / 2, abs=2 * HALF_A_DEGREE)
    assert loop.controller.mode == 'hold'
    assert loop.controller.saturated == 0
    assert loop.supervisor.arming.armed
    assert not loop.supervisor.rejected
    assert not loop.estimator.rejected
    assert loop.estimator.starts == 1


@pytest.mark.medium
def test_quarter_turn_of_the_paper(make_loop: MakeLoop) -> None:
    loop = make_loop()
    steps = quarter_turn(loop)
    check_tracking(loop, steps)
    speeds = np.abs([absolute_speeds(step) for step in steps]).max(axis=0)
    assert speeds == pytest.approx(np.full(4, PEAK), rel=0.1)
    energy = max(step.control.energies[FLYWHEEL_ENERGY] for step in steps if step.control)
    assert energy == pytest.approx(2.6452e-3, rel=0.1)


@pytest.mark.medium
@pytest.mark.parametrize('branch', ['open', 'crossed'])
def test_linkage_without_symmetry_on_both_branches(
    branch: str, uneven: Mechanism, make_loop: MakeLoop,
) -> None:
    """The linkage turns and changes its configuration in one move."""
    loop = make_loop(uneven, 1.5, branch)
    steps = quarter_turn(loop, change=0.3)
    check_tracking(loop, steps)
    assert branch_of(steps[-1].samples.truth.link_angles) == branch  # type: ignore[union-attr]


@pytest.mark.medium
def test_crossed_branch_of_an_antiparallelogram(make_loop: MakeLoop) -> None:
    """Opposite links are equal and neighbours are not."""
    rectangle = Mechanism(  # type: ignore[arg-type]
        [0.12, 0.08, 0.12, 0.08], [0.02] * 4, [2.2e-5] * 4, [[0.05, 0.0]] * 4, [3.4e-7] * 4,
        [1e-4] * 4, [500.0] * 4)
    loop = make_loop(rectangle, 1.2, 'crossed')
    steps = quarter_turn(loop)
    check_tracking(loop, steps)
    assert branch_of(steps[-1].samples.truth.link_angles) == 'crossed'  # type: ignore[union-attr]


def momentum(loop: ClosedLoop, step: Step) -> float:
    truth = step.samples.truth
    assert truth is not None
    return angular_momentum(loop.supervisor.device.mechanism, truth.link_angles, truth.link_rates,
                            absolute_speeds(step))


@pytest.mark.medium
def test_total_momentum_stays_zero_while_wheels_and_links_exchange_it(make_loop: MakeLoop) -> None:
    loop = make_loop()
    steps = quarter_turn(loop)
    traded = 3.4e-7 * PEAK * 4
    # Bound of the rounding errors: 22000 steps with ten roundings of one sign.
    assert max(abs(momentum(loop, step)) for step in steps) < 22000 * 10 * 1.1e-16 * traded


@pytest.mark.medium
def test_emergency_stop_in_motion_lets_the_wheels_coast(make_loop: MakeLoop) -> None:
    loop = make_loop()
    loop.controller.setpoint(['link_a', 'link_b'], [pi / 2, pi / 3 + pi / 2])
    for _ in range(1250):
        loop.step()
    loop.supervisor.emergency_stop('test')
    steps = [loop.step() for _ in range(500)]
    assert loop.supervisor.arming.state is DeviceState.EMERGENCY_STOP
    speeds = np.array([absolute_speeds(step) for step in steps])
    assert np.abs(speeds[0]).min() > 0.9 * PEAK
    np.testing.assert_allclose(speeds, speeds[0] + np.zeros((500, 4)), rtol=1e-14)
    for step in steps:
        assert step.control is not None
        assert not step.samples.wheels.efforts.any()
        assert not step.control.torques.any()
    # The links keep their momentum: no torque acts on the whole.
    assert momentum(loop, steps[-1]) == pytest.approx(0.0, abs=1e-11 * 3.4e-7 * PEAK * 4)
    truth = steps[-1].samples.truth
    assert truth is not None
    assert np.abs(truth.link_rates).min() > 0.2
    assert loop.controller.goal is None
    assert loop.arm()[0] is False


@pytest.mark.medium
def test_run_again_after_an_emergency_stop(make_loop: MakeLoop) -> None:
    """After reset and arming, the controller stops the drifting links."""
    loop = make_loop()
    loop.controller.setpoint(['link_a', 'link_b'], [pi / 2, pi / 3 + pi / 2])
    for _ in range(600):
        loop.step()
    loop.supervisor.emergency_stop('test')
    for _ in range(100):
        loop.step()
    assert loop.supervisor.reset()[0]
    assert loop.arm()[0]
    for _ in range(1000):
        step = loop.step()
    truth = step.samples.truth
    assert truth is not None
    # 4 s are more than ten time constants of the law; the measurement noise remains.
    assert np.abs(truth.link_rates).max() < 0.02
    assert loop.controller.mode == 'hold'


def fingerprint(loop: ClosedLoop) -> bytes:
    """Return all numbers of a short manoeuvre."""
    loop.controller.setpoint(['link_a'], [0.3])
    values: list[Array] = []
    for _ in range(300):
        step = loop.step()
        assert step.estimate is not None
        assert step.control is not None
        assert step.samples.truth is not None
        values += [
            step.samples.links[0].angles, step.samples.wheels.angles, step.samples.wheels.speeds,
            step.samples.truth.link_angles, step.estimate.link_angles, step.estimate.rate_sigmas,
            step.control.torques, step.control.reference_angles]
    return np.array(values).tobytes()


@pytest.mark.medium
def test_same_seed_same_bytes(make_loop: MakeLoop) -> None:
    first = fingerprint(make_loop(seed=5))
    assert first == fingerprint(make_loop(seed=5))
    assert first != fingerprint(make_loop(seed=6))


def test_stamps_rise_by_one_period_and_answers_carry_them(make_loop: MakeLoop) -> None:
    loop = make_loop(settled=False)
    stamps = []
    for _ in range(5):
        step = loop.step()
        stamps.append(step.samples.stamp_ns)
        if step.estimate and step.control:
            assert step.estimate.stamp_ns == step.control.stamp_ns == step.samples.stamp_ns
    assert np.diff(stamps).tolist() == [PERIOD_NS] * 4
    assert not loop.supervisor.rejected


def test_unarmed_loop_does_not_move(make_loop: MakeLoop) -> None:
    loop = make_loop(settled=False)
    for _ in range(100):
        step = loop.step()
        assert not step.samples.wheels.efforts.any()
    truth = step.samples.truth
    assert truth is not None
    np.testing.assert_allclose(truth.link_angles, [0.0, pi / 3, 0.0, pi / 3], atol=1e-15)
