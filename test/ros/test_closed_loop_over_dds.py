# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loop of plant, estimator and controller as processes: conservation laws and errors."""

from fourbar_ros.mechanism import load_mechanism
import numpy as np
import pytest
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.node

DURATION_S = 2.0
GOAL = [0.5, 1.4]
# Time to settle after a move [s].
SETTLE_S = 1.5


def by_stamp(messages):
    return {message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec: message
            for message in messages}


@pytest.fixture(scope='module')
def run(module_suite, probe):
    """Arm, move and settle; return all messages by topic and stamp."""
    module_suite.nodes(fresh=True, controller={'setpoint_duration': DURATION_S})
    topics = ('sim/link_states', 'sim/flywheel_states', 'estimate/link_states', 'estimate/sigma',
              'estimate/innovation', 'reference', 'tracking_error', 'energy')
    probe.follow(*topics)
    probe.newest('reference')
    probe.wait(lambda: probe.arm().success)
    probe.status('controller_status', mode='hold')
    decision = probe.setpoint_decision(
        JointState(name=['link_a', 'link_b'], position=GOAL),
        probe.publisher(JointState, 'setpoint'))
    assert decision['mode'] == 'track'
    probe.status('controller_status', mode='hold')
    probe.more('reference', round(SETTLE_S * 250))
    assert probe.status('device_status')['state'] == 'armed'
    probe.catch_up()
    return {topic: by_stamp(probe.received[topic]) for topic in topics}


def paired(run, *topics):
    """Return the messages of some topics at their common stamps, in order of time."""
    stamps = sorted(set.intersection(*(set(run[topic]) for topic in topics)))
    assert len(stamps) > 500
    return [[run[topic][stamp] for stamp in stamps] for topic in topics]


def test_goal_is_reached(run):
    final = run['sim/link_states'][max(run['sim/link_states'])]
    assert np.abs(np.array(final.position)[:2] - GOAL).max() < np.radians(0.5)
    # The linkage of the paper is a parallelogram on this branch.
    assert final.position[2:] == pytest.approx(final.position[:2], abs=1e-6)


def test_angular_momentum_of_links_and_wheels_is_conserved(run):
    """The test computes the momentum about the common mass centre from angles and rates."""
    mechanism = load_mechanism('paper')
    masses, lengths = mechanism.link_masses, mechanism.link_lengths
    total, largest = [], 0.0
    for links, wheels in zip(*paired(run, 'sim/link_states', 'sim/flywheel_states')):
        angles, rates = np.array(links.position), np.array(links.velocity)
        along = np.exp(1j * angles)
        # Joint 1 is the origin: links a and b begin there, c at the end of b, d at the end of a.
        near = np.array([0.0, 0.0, lengths[1] * along[1], lengths[0] * along[0]])
        near_speed = 1j * np.array([0.0, 0.0, lengths[1] * along[1] * rates[1],
                                    lengths[0] * along[0] * rates[0]])
        arms = (mechanism.com_positions[:, 0] + 1j * mechanism.com_positions[:, 1]) * along
        positions, speeds = near + arms, near_speed + 1j * arms * rates
        positions = positions - masses @ positions / masses.sum()
        speeds = speeds - masses @ speeds / masses.sum()
        orbital = float(masses @ (positions.conj() * speeds).imag)
        of_wheels = float(mechanism.flywheel_inertias @ (np.array(wheels.velocity) + rates))
        total.append(orbital + float(mechanism.link_inertias @ rates) + of_wheels)
        largest = max(largest, abs(of_wheels))
    assert largest > 1e-6
    assert np.ptp(total) < 1e-9 * largest


def test_estimate_agrees_with_the_truth(run):
    estimates, truths = paired(run, 'estimate/link_states', 'sim/link_states')
    errors = np.array([np.array(estimate.position) - truth.position
                       for estimate, truth in zip(estimates, truths)])
    assert np.sqrt(np.mean(errors ** 2)) < np.radians(0.1)


def test_estimate_errors_agree_with_sigma(run):
    """The run is short, so the bounds on errors and NIS are wide."""
    estimates, sigmas, truths = paired(
        run, 'estimate/link_states', 'estimate/sigma', 'sim/link_states')
    normalised = np.array([
        (np.array(estimate.position) - truth.position) / sigma.position
        for estimate, sigma, truth in zip(estimates, sigmas, truths)])
    assert 0.2 < np.sqrt(np.mean(normalised ** 2)) < 3.0
    nis = [message.position[0] / message.position[1]
           for message in run['estimate/innovation'].values()]
    # The mean of n chi-square variables with 4 degrees of freedom, over 4, is 1 +- sqrt(1 / 2n).
    assert np.mean(nis) == pytest.approx(1.0, abs=5.0 * np.sqrt(0.5 / len(nis)) + 0.1)


def test_tracking_error_is_reference_minus_estimate(run):
    for reference, error, estimate in zip(*paired(
            run, 'reference', 'tracking_error', 'estimate/link_states')):
        for field in ('position', 'velocity'):
            difference = np.subtract(getattr(reference, field), getattr(estimate, field))
            assert getattr(error, field) == pytest.approx(difference, abs=1e-15)


def test_links_follow_the_reference_during_the_move(run):
    references, truths = paired(run, 'reference', 'sim/link_states')
    errors = np.array([np.array(reference.position) - truth.position
                       for reference, truth in zip(references, truths)])
    assert np.abs(errors).max() < np.radians(2.0)
    assert np.sqrt(np.mean(errors ** 2)) < np.radians(0.5)


def test_energy_is_that_of_the_wheels(run):
    """The published energy is eq. 7 with the true wheel speeds, within the encoder resolution."""
    inertia = load_mechanism('paper').flywheel_inertias
    energies, wheels, links = paired(run, 'energy', 'sim/flywheel_states', 'sim/link_states')
    expected = np.array([0.5 * inertia @ (np.array(wheel.velocity) + link.velocity) ** 2
                         for wheel, link in zip(wheels, links)])
    published = np.array([message.position[0] for message in energies])
    assert expected.max() > 1e-5
    assert published == pytest.approx(expected, abs=0.05 * expected.max())
    # The two sums since arming are monotonic.
    armed = np.array([message.position[1:] for message in energies])
    assert (np.diff(armed[armed[:, 1] > 0.0], axis=0) >= 0.0).all()
