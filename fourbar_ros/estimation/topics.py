# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The estimator behind its topics: messages in, messages out, whoever carries them.

The node hands over what the middleware brings, the replay of a bag what a recorder kept. Both get
the same answers, so a replay with the settings of the node says what the node said.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.common.names import (
    ESTIMATE_COVARIANCE,
    ESTIMATE_DECISIONS,
    ESTIMATE_DISTURBANCE,
    ESTIMATE_GYRO_BIAS,
    ESTIMATE_INNOVATION,
    ESTIMATE_LINK_STATES,
    ESTIMATE_SIGMA,
    ESTIMATE_WAITING,
    FLYWHEEL_COMMAND,
    FLYWHEEL_STATES,
    LINK_ANGLES,
)
from fourbar_ros.estimation.estimate import ACCEPTED, Estimate
from fourbar_ros.estimation.estimator import BY_COMMAND, BY_NOTHING, Estimator, STATE_NAMES
from fourbar_ros.estimation.measurement import sensor_name
from fourbar_ros.estimation.settings import EstimatorSettings
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, Mechanism, SENSOR_NAMES
from fourbar_ros.mechanism.constants import Array
import numpy as np

# The upper triangle, row by row.
COVARIANCES = tuple(
    f'{row}.{column}' for n, row in enumerate(STATE_NAMES) for column in STATE_NAMES[n:])
# The disturbance torques and one standard deviation of each [N m].
DISTURBANCES = ('torque_a', 'torque_b', 'sigma_a', 'sigma_b')
UPPER = np.triu_indices(len(STATE_NAMES))

INPUTS = (LINK_ANGLES, FLYWHEEL_STATES)
"""JointState topics of the estimator; FLYWHEEL_COMMAND only while `needs_commands`."""


class Output(NamedTuple):
    """
    A JointState topic that the estimator publishes.

    :param names: in their order; a message may leave some out, or carry others.
    :param fields: those of position, velocity, effort that are used.
    :param frame: in which orientations are given, or ''.
    :param optional: whether it is there only once there is something to say.
    """

    names: tuple[str, ...]
    fields: tuple[str, ...] = ('position', 'velocity')
    frame: str = ''
    optional: bool = False


OUTPUTS = {
    ESTIMATE_LINK_STATES: Output(LINK_NAMES, ('position', 'velocity', 'effort'), frame='table'),
    ESTIMATE_SIGMA: Output(LINK_NAMES),
    ESTIMATE_COVARIANCE: Output(COVARIANCES, ('position',)),
    ESTIMATE_DISTURBANCE: Output(DISTURBANCES, ('position',)),
    ESTIMATE_GYRO_BIAS: Output(LINK_NAMES, ('velocity',), optional=True),
    ESTIMATE_DECISIONS: Output(LINK_NAMES, ('position', 'velocity', 'effort')),
    ESTIMATE_INNOVATION: Output(('nis', 'degrees_of_freedom', *LINK_NAMES), ('position',)),
}


class Message(NamedTuple):
    """
    What is to be published.

    :param topic: of `OUTPUTS`, or `ESTIMATE_WAITING`, which has a stamp and nothing else.
    :param stamp_ns: of the header [ns].
    :param names: k of them.
    :param values: an array (k,) for each of the topic's fields.
    """

    topic: str
    stamp_ns: int
    names: tuple[str, ...] = ()
    values: tuple[Array, ...] = ()


class Answer(NamedTuple):
    """
    What a message led to.

    :param messages: to be published in this order, each made when it is asked for: whoever waits
        for the first need not wait for the others.
    :param rejection: why the message was not used, or ''.
    """

    messages: Iterable[Message] = ()
    rejection: str = ''


class EstimatorTopics:
    """
    Hands messages to an estimator, and gives what it has to say.

    :ivar estimator: the one that they are handed to.
    """

    def __init__(self, mechanism: Mechanism, settings: EstimatorSettings) -> None:
        self.estimator = Estimator(mechanism, settings)
        self._last: tuple[int, Estimate | None] | None = None

    def receive(self, topic: str, stamp_ns: int, names: Sequence[str], position: Sequence[float],
                velocity: Sequence[float], effort: Sequence[float]) -> Answer:
        """
        Take a message; one that is of no use is counted, and changes nothing.

        :param topic: one of `INPUTS`, or FLYWHEEL_COMMAND.
        :param stamp_ns: of the header [ns].
        :param names, position, velocity, effort: as they are in the message.
        """
        if topic == FLYWHEEL_STATES:
            return self._tick(stamp_ns, names, velocity, effort)
        if topic == FLYWHEEL_COMMAND:
            if tuple(names) == FLYWHEEL_NAMES:
                self.estimator.commanded(effort)
            return Answer()
        try:
            self.estimator.measure(stamp_ns, names, position, velocity)
        except RejectedError as error:
            return Answer(rejection=str(error))
        return Answer()

    @property
    def needs_commands(self) -> bool:
        """Tell whether ticks say neither what the wheels did nor what drove them."""
        return self.estimator.driven_by in (BY_COMMAND, BY_NOTHING)

    def _tick(self, stamp_ns: int, names: Sequence[str], velocity: Sequence[float],
              effort: Sequence[float]) -> Answer:
        if self._last is not None and self._last[0] == stamp_ns:
            # A lock-step sends a tick again when its answer was lost.
            return Answer(messages_of(self.estimator, *self._last))
        try:
            if tuple(names) != FLYWHEEL_NAMES:
                error = RejectedError('wheels', f'the names must be {", ".join(FLYWHEEL_NAMES)}')
                self.estimator.reject(error)
                raise error
            estimate = self.estimator.tick(stamp_ns, velocity, effort)
        except RejectedError as error:
            return Answer((Message(ESTIMATE_WAITING, stamp_ns),), str(error))
        self._last = stamp_ns, estimate
        return Answer(messages_of(self.estimator, stamp_ns, estimate))


def messages_of(estimator: Estimator, stamp_ns: int, estimate: Estimate | None
                ) -> Iterator[Message]:
    """
    Say what the estimate of a tick is, or that there is none: either answers a lock-step.

    :param estimator: at that tick.
    """
    if estimate is None:
        yield Message(ESTIMATE_WAITING, stamp_ns)
        return
    yield Message(ESTIMATE_LINK_STATES, stamp_ns, LINK_NAMES, (
        estimate.link_angles, estimate.link_rates, estimate.link_torques))
    yield Message(ESTIMATE_SIGMA, stamp_ns, LINK_NAMES,
                  (estimate.angle_sigmas, estimate.rate_sigmas))
    yield Message(ESTIMATE_COVARIANCE, stamp_ns, COVARIANCES, (estimate.covariance[UPPER],))
    yield Message(ESTIMATE_DISTURBANCE, stamp_ns, DISTURBANCES, (
        np.concatenate([estimate.disturbance, estimate.disturbance_sigmas]),))
    if estimate.gyro_biases:
        yield Message(ESTIMATE_GYRO_BIAS, stamp_ns,
                      tuple(SENSOR_NAMES[sensor] for sensor in estimate.gyro_biases), (
                          np.array(list(estimate.gyro_biases.values())),))
    if decisions := estimator.decisions():
        sensors, reasons, squares = zip(*decisions)
        accepted = np.array(reasons) == ACCEPTED
        yield Message(ESTIMATE_DECISIONS, stamp_ns,
                      tuple(SENSOR_NAMES[sensor] for sensor in sensors), (
                          np.array(reasons, float), np.array(squares), accepted.astype(float)))
    if (seen := estimate.innovation) is not None:
        names = ('nis', 'degrees_of_freedom', *map(sensor_name, seen.sensors))
        yield Message(ESTIMATE_INNOVATION, stamp_ns, names, (
            np.array([seen.nis, seen.degrees_of_freedom, *seen.values]),))
