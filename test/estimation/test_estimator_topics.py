# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The messages of the estimator agree with its estimates."""

from dataclasses import fields

from fourbar_ros.estimation import Estimator, EstimatorSettings
from fourbar_ros.estimation.estimator_settings import PARAMETERS, SETTINGS
from fourbar_ros.estimation.estimator_topics import EstimatorTopics, INPUTS, OUTPUTS, Response
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, Mechanism
import numpy as np
import pytest

ANGLES = [0.1, 1.2, 0.1, 1.2]
TICK_NS = 4_000_000


GYROS = [0.01, -0.01, 0.02, 0.0]


@pytest.fixture
def topics(paper: Mechanism) -> EstimatorTopics:
    return EstimatorTopics(paper, EstimatorSettings())


def tick(topics: EstimatorTopics, number: int, speed: float = 0.0) -> Response:
    return topics.receive('flywheel_states', number * TICK_NS, FLYWHEEL_NAMES, [0.0] * 4,
                          [speed] * 4, [0.0] * 4)


def sample(topics: EstimatorTopics, number: int) -> Response:
    return topics.receive('link_angles', number * TICK_NS, LINK_NAMES, ANGLES, GYROS, [])


def test_settings_are_the_fields_with_their_defaults() -> None:
    assert {row.name: row.default for row in SETTINGS} == {
        item.name: item.default for item in fields(EstimatorSettings)}
    assert [row.name for row in PARAMETERS] == ['mechanism', *(row.name for row in SETTINGS)]


def test_tick_without_estimate_is_answered(topics: EstimatorTopics) -> None:
    message, = tick(topics, 1).messages
    assert (message.topic, message.stamp_ns) == ('estimate/waiting', TICK_NS)


def test_messages_carry_the_whole_estimate(topics: EstimatorTopics, paper: Mechanism) -> None:
    plain = Estimator(paper, EstimatorSettings())
    for number in (1, 2):
        assert sample(topics, number) == Response()
        plain.measure(number * TICK_NS, LINK_NAMES, ANGLES, GYROS)
        answer, estimate = tick(topics, number, 0.1), plain.tick(number * TICK_NS, [0.1] * 4)
    assert estimate is not None
    assert estimate.innovation is not None
    said = {message.topic: message for message in answer.messages}
    assert list(said) == list(OUTPUTS)
    for topic, message in said.items():
        assert (message.stamp_ns, message.names[:len(OUTPUTS[topic].names)]) == (
            2 * TICK_NS, OUTPUTS[topic].names)
        assert len(message.values) == len(OUTPUTS[topic].fields)
        assert all(len(values) == len(message.names) for values in message.values)
        # Serialisers take their bytes as they are.
        assert all(values.flags.c_contiguous for values in message.values)
    assert np.array_equal(said['estimate/link_states'].values,
                          [estimate.link_angles, estimate.link_rates,
                           [*estimate.disturbance, 0.0, 0.0]])
    assert np.array_equal(said['estimate/sigma'].values,
                          [estimate.angle_sigmas, estimate.rate_sigmas])
    innovation = estimate.innovation
    assert said['estimate/innovation'].values[0].tolist() == [
        innovation.nis, innovation.degrees_of_freedom, *innovation.values]
    assert said['estimate/innovation'].names[-1] == 'gyro_link_d'
    assert said['estimate/gyro_bias'].values[0].tolist() == list(estimate.gyro_biases.values())
    reasons, squares, freedom = said['estimate/decisions'].values
    assert reasons.tolist() == [0.0] * 4 and freedom.tolist() == [1.0] * 4
    assert squares.tolist() == [status.nis for status in plain.sample_statuses()]
    covariance = dict(zip(said['estimate/covariance'].names,
                          said['estimate/covariance'].values[0], strict=True))
    assert covariance['phi_b.phi_b'] == estimate.covariance[1, 1]
    assert covariance['phi_a.omega_b'] == estimate.covariance[0, 3]


def test_repeated_tick_gets_the_same_response(topics: EstimatorTopics) -> None:
    sample(topics, 1)
    first, second = (list(tick(topics, 1).messages) for _ in range(2))
    assert [message[:3] for message in first] == [message[:3] for message in second]
    for one, other in zip(first, second):
        assert all(map(np.array_equal, one.values, other.values))
    assert not topics.estimator.rejected


@pytest.mark.parametrize('topic', INPUTS)
def test_rejection_is_in_the_response(topics: EstimatorTopics, topic: str) -> None:
    answer = topics.receive(topic, TICK_NS, ['link_x'], [0.0], [0.0], [0.0])
    assert answer.rejection == topics.estimator.last_rejection != ''
    # A tick is answered all the same: a lock-step waits for it.
    assert [message.topic for message in answer.messages] == (
        ['estimate/waiting'] if topic == 'flywheel_states' else [])


def test_commands_replace_missing_wheel_motion(topics: EstimatorTopics) -> None:
    def silent_tick(number: int) -> None:
        topics.receive('flywheel_states', number * TICK_NS, FLYWHEEL_NAMES, [], [], [])
    sample(topics, 1)
    tick(topics, 1)
    tick(topics, 2)
    assert not topics.needs_commands
    silent_tick(3)
    assert topics.needs_commands
    assert topics.receive('flywheel_command', 3 * TICK_NS, FLYWHEEL_NAMES, [], [], [1e-6] * 4
                          ) == Response()
    silent_tick(4)
    assert topics.estimator.driven_by == 'commanded efforts'
    assert topics.needs_commands
    # A command of other wheels, or of speeds, is no help.
    topics.receive('flywheel_command', 4 * TICK_NS, ['flywheel_x'], [], [], [1.0])
    topics.receive('flywheel_command', 4 * TICK_NS, FLYWHEEL_NAMES, [], [1.0] * 4, [])
    silent_tick(5)
    assert topics.estimator.driven_by == 'commanded efforts'
