# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The collapsed linkage: admissible motions, generalized forces of drives, and stiffness."""

import csv
from io import BytesIO, StringIO

from fourbar_ros.mechanism import closure_error, joint_positions, load_mechanism
from fourbar_ros.mechanism.forces import NOTHING, surroundings
from fourbar_ros.mechanism.mechanism import JOINT_LINKS
from fourbar_ros.studies import load_study, Result, singularity_model
from fourbar_ros.studies.crossing_runs import STIFFNESS
from fourbar_ros.studies.singularity_model import (
    AWAY,
    closure_jacobian,
    DRIVES,
    ETA,
    eta_inertia,
    generalized_forces,
    integrate_eta,
    joint_force,
    joint_motor,
    LOCKS,
    MODES,
    motions,
    output_stiffness,
    rank,
    wheel_motor,
)
import numpy as np
import pytest

PROTOTYPE = load_mechanism('prototype')
LENGTH = float(PROTOTYPE.link_lengths[0])
SMALL = 1e-5


def test_collapsed_linkage_moves_with_its_input_joint_locked() -> None:
    """The motion is finite: c and d turn about joints 2 and 4 by any angle."""
    for eta in np.linspace(-3.0, 3.0, 13):
        assert closure_error(PROTOTYPE, [0.0, 0.0, eta, eta]) < 1e-15
    # At other angles links c and d have only two isolated assemblies.
    for theta in (0.2, AWAY, 1.5):
        gaps = [closure_error(PROTOTYPE, [0.0, theta, c, d])
                for c in np.linspace(-3.1, 3.1, 63) for d in np.linspace(-3.1, 3.1, 63)
                if abs(c) + abs(d - theta) > 0.15 and abs(c - theta) + abs(d) > 0.15]
        assert min(gaps) > 0.02 * LENGTH * theta


@pytest.mark.parametrize('theta', [0.0, 0.3, AWAY])
@pytest.mark.parametrize('locked', list(LOCKS))
def test_only_admissible_motions_keep_the_loop_closed(
    theta: float, locked: tuple[int, ...],
) -> None:
    """The gap is quadratic in an admissible motion, and linear in all others."""
    angles = np.tile([0.0, theta], 2)
    basis = motions(PROTOTYPE, theta, locked)
    assert basis.shape[1] == LOCKS[locked][0 if theta == 0.0 else 1]
    for motion in basis.T:
        assert closure_error(PROTOTYPE, angles + SMALL * motion) < 2.0 * LENGTH * SMALL ** 2
        for joint in locked:
            first, second = JOINT_LINKS[joint]
            assert motion[first] == pytest.approx(motion[second], abs=1e-12)
    rng = np.random.default_rng(0)
    for _ in range(20):
        other = rng.normal(size=4)
        other -= basis @ (basis.T @ other)
        opens = closure_error(PROTOTYPE, angles + SMALL * other) / SMALL
        slides = max((abs(other @ joint_motor(joint)) for joint in locked), default=0.0)
        assert max(opens / LENGTH, slides) > 1e-3 * float(np.abs(other).max()), 'seed 0'


def test_modes_are_motions_at_zero() -> None:
    np.testing.assert_allclose(closure_jacobian(PROTOTYPE, 0.0) @ MODES, 0.0, atol=1e-16)
    assert rank(MODES) == 3
    # Motion eta turns opposite links apart, and no pair in the mean.
    assert ETA[2] - ETA[0] == ETA[3] - ETA[1] == 1.0
    assert ETA[0] + ETA[2] == ETA[1] + ETA[3] == 0.0


def test_generalized_forces_are_the_work_of_the_motors() -> None:
    """The work of a joint motor is on the joint angle, that of a wheel on minus the link angle."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        rates = rng.normal(size=4)
        for joint, (first, second) in enumerate(JOINT_LINKS):
            assert joint_motor(joint) @ rates == pytest.approx(rates[second] - rates[first])
            assert joint_motor(joint).sum() == 0.0
        for wheel in range(4):
            assert wheel_motor(wheel) @ rates == pytest.approx(-rates[wheel])


def test_no_joint_motor_turns_the_whole_and_one_alone_drives_one_motion() -> None:
    whole = np.full(4, 0.5)
    for theta in (0.0, 0.2, AWAY):
        for joint in range(4):
            assert whole @ joint_motor(joint) == 0.0
            assert rank(generalized_forces(PROTOTYPE, theta, joint_motor(joint)[:, None])) == 1
        # The rank of all joint motors is lower than that of four wheels.
        assert rank(generalized_forces(PROTOTYPE, theta, DRIVES['four_joints'])) < rank(
            generalized_forces(PROTOTYPE, theta, DRIVES['four_wheels']))


def test_four_wheels_drive_every_motion_equally_and_two_miss_one() -> None:
    for theta in (-AWAY, -1e-3, 0.0, 1e-9, 0.3):
        gains = np.linalg.svd(
            generalized_forces(PROTOTYPE, theta, DRIVES['four_wheels']), compute_uv=False)
        np.testing.assert_allclose(gains, 1.0, atol=1e-12)
    missed = np.linalg.svd(generalized_forces(PROTOTYPE, 0.0, DRIVES['wheels_a_b']))
    left = motions(PROTOTYPE, 0.0) @ missed[0][:, 2]
    # In this motion links c and d turn, and a and b rest.
    np.testing.assert_allclose(left[:2], 0.0, atol=1e-12)
    assert abs(left[2]) == pytest.approx(abs(left[3]))


@pytest.mark.parametrize('theta', [0.01, 0.2, AWAY, 1.4])
def test_stiffness_is_that_of_four_bodies_on_springs(theta: float) -> None:
    """The reference solves nine coordinates with link a fixed and a torque on link d."""
    places = joint_positions(PROTOTYPE, np.tile([0.0, theta], 2))
    ends = {0: (0, 1), 1: (1, 2), 2: (2, 3), 3: (3, 0)}
    stiffness = np.zeros((9, 9))
    for joint, links in ends.items():
        rows = np.zeros((2, 9))
        for link, sign in zip(links, (-1.0, 1.0)):
            if link > 0:
                at = 3 * (link - 1)
                arm = places[joint]
                rows[0, at], rows[1, at + 1] = sign, sign
                rows[:, at + 2] = sign * np.array([-arm[1], arm[0]])
        stiffness += STIFFNESS * rows.T @ rows
    # With joint 1 locked, link b does not turn.
    kept = [0, 1, 3, 4, 5, 6, 7, 8]
    torque = np.zeros(8)
    torque[-1] = 1.0
    turned = np.linalg.solve(stiffness[np.ix_(kept, kept)], torque)[-1]
    assert output_stiffness(PROTOTYPE, theta) == pytest.approx(1.0 / turned, rel=1e-6)


@pytest.mark.parametrize('theta', [0.05, AWAY, -0.3])
def test_force_in_the_coupler_balances_the_torque(theta: float) -> None:
    """The force is along link c and has its moment about joint 4."""
    _, _, joint_3, joint_4 = joint_positions(PROTOTYPE, np.tile([0.0, theta], 2))
    arm = joint_3 - joint_4
    along_c = np.array([1.0, 0.0])
    moment = abs(arm[0] * along_c[1] - arm[1] * along_c[0])
    assert joint_force(PROTOTYPE, theta) * moment == pytest.approx(1.0)
    assert np.isnan(joint_force(PROTOTYPE, 0.0))


def test_opposite_wheels_move_the_integrated_linkage_and_joint_motors_do_not() -> None:
    square = 0.5 * singularity_model.TORQUE * singularity_model.PUSH_TIME ** 2
    for shares in ([1.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, -1.0], [0.5, 0.5, -0.5, -0.5]):
        opened = integrate_eta(PROTOTYPE, np.array(shares), NOTHING)
        assert opened == pytest.approx(square / eta_inertia(PROTOTYPE, 0.0), rel=1e-8)
    for joint in (0, 2):
        around = surroundings(link_torques=singularity_model.TORQUE * joint_motor(joint))
        assert abs(integrate_eta(PROTOTYPE, np.zeros(4), around)) < 1e-12
    alike = integrate_eta(PROTOTYPE, np.array([1.0, 1.0, 1.0, 1.0]), NOTHING)
    assert abs(alike) < 1e-12


@pytest.fixture(scope='module')
def result() -> Result:
    """Return the result of the study."""
    return load_study('singularity')(lambda items, count: items)


@pytest.mark.slow
def test_checks_pass_and_results_are_complete(result: Result) -> None:
    assert [check.name for check in result.checks if not check.passed] == []
    assert len({check.name for check in result.checks}) == len(result.checks)
    assert result.data['generalized_forces']['joint_1']['eta'] == [0.0]
    assert result.data['parked_passed'] == {'four_held': True, 'two': False}
    parked = result.data['parked_largest_eta_deg']
    assert parked['two'] > 100.0 * parked['four_held']
    rows = list(csv.DictReader(StringIO(str(result.files['singularity.csv']))))
    middle, = (row for row in rows if float(row['theta_deg']) == 0.0)
    assert middle['joint_force_n_per_n_m'] == ''
    assert float(middle['closure_smaller_m']) == pytest.approx(0.0, abs=1e-15)
    for row in rows:
        assert float(row['wheel_map_smaller']) == pytest.approx(np.sqrt(2.0))
        assert float(row['closure_smaller_m']) == pytest.approx(
            2.0 * LENGTH * abs(np.sin(0.5 * np.radians(float(row['theta_deg'])))), abs=1e-9)


@pytest.mark.slow
def test_figure_is_complete(result: Result) -> None:
    """The figure has contents in the middle and none at the edges."""
    image = pytest.importorskip('matplotlib.image')
    assert result.skipped == []
    png = result.files['singularity.png']
    assert isinstance(png, bytes)
    pixels = image.imread(BytesIO(png))[..., :3]
    assert pixels.std() > 0.05
    for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
        assert edge.min() == 1.0
