# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The topics of the estimator: messages in, messages out, independent of their transport.

The node passes messages of the middleware, the replay of a bag passes recorded messages. Both get
the same responses, so a replay with the settings of the node reproduces its output.
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
from fourbar_ros.estimation.estimator import Estimator, STATE_NAMES
from fourbar_ros.estimation.estimator_settings import EstimatorSettings
from fourbar_ros.estimation.measurement import sensor_name
from fourbar_ros.estimation.wheel_motion import BY_COMMAND, BY_NOTHING
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.constants import Array
import numpy as np

COVARIANCES = tuple(
    f'{row}.{column}' for n, row in enumerate(STATE_NAMES) for column in STATE_NAMES[n:])
"""Names of the upper triangle of the covariance, row by row."""

DISTURBANCES = ('torque_a', 'torque_b', 'sigma_a', 'sigma_b')
"""Names of the disturbance torques and their standard deviations [N m]."""

INPUTS = (LINK_ANGLES, FLYWHEEL_STATES)
"""JointState topics of the estimator; FLYWHEEL_COMMAND only while `needs_commands`."""

_UPPER = np.triu_indices(len(STATE_NAMES))


class OutputTopic(NamedTuple):
    """
    A JointState topic that the estimator publishes.

    :param names: of the elements, in order; a message may omit some or carry others.
    :param fields: those of position, velocity, effort that are used.
    :param frame: of orientations, or ''.
    :param optional: whether the topic exists only from its first message on.
    """

    names: tuple[str, ...]
    fields: tuple[str, ...] = ('position', 'velocity')
    frame: str = ''
    optional: bool = False


OUTPUTS = {
    ESTIMATE_LINK_STATES: OutputTopic(
        LINK_NAMES, ('position', 'velocity', 'effort'), frame='table'),
    ESTIMATE_SIGMA: OutputTopic(LINK_NAMES),
    ESTIMATE_COVARIANCE: OutputTopic(COVARIANCES, ('position',)),
    ESTIMATE_DISTURBANCE: OutputTopic(DISTURBANCES, ('position',)),
    ESTIMATE_GYRO_BIAS: OutputTopic(LINK_NAMES, ('velocity',), optional=True),
    ESTIMATE_DECISIONS: OutputTopic(LINK_NAMES, ('position', 'velocity', 'effort')),
    ESTIMATE_INNOVATION: OutputTopic(('nis', 'degrees_of_freedom', *LINK_NAMES), ('position',)),
}


class OutputMessage(NamedTuple):
    """
    A message to be published.

    :param topic: of `OUTPUTS`, or `ESTIMATE_WAITING`, which has a stamp only.
    :param stamp_ns: of the header [ns].
    :param names: k names.
    :param values: an array (k,) for each of the topic's fields.
    """

    topic: str
    stamp_ns: int
    names: tuple[str, ...] = ()
    values: tuple[Array, ...] = ()


class Response(NamedTuple):
    """
    Response to a message.

    :param messages: to be published in this order. Each is made on demand, so that the first one
        does not wait for the others.
    :param rejection: reason of a rejection, or ''.
    """

    messages: Iterable[OutputMessage] = ()
    rejection: str = ''


class EstimatorTopics:
    """
    Passes messages to an estimator, and its results to messages.

    :ivar estimator: the estimator.
    """

    def __init__(self, mechanism: Mechanism, settings: EstimatorSettings) -> None:
        self.estimator = Estimator(mechanism, settings)
        self._last: tuple[int, Estimate | None] | None = None

    def receive(self, topic: str, stamp_ns: int, names: Sequence[str], position: Sequence[float],
                velocity: Sequence[float], effort: Sequence[float]) -> Response:
        """
        Process a message; a rejected one is counted and changes nothing.

        :param topic: one of `INPUTS`, or FLYWHEEL_COMMAND.
        :param stamp_ns: of the header [ns].
        :param names, position, velocity, effort: of the message.
        """
        if topic == FLYWHEEL_STATES:
            return self._tick(stamp_ns, names, velocity, effort)
        if topic == FLYWHEEL_COMMAND:
            if tuple(names) == FLYWHEEL_NAMES:
                self.estimator.set_command(effort)
            return Response()
        try:
            self.estimator.measure(stamp_ns, names, position, velocity)
        except RejectedError as error:
            return Response(rejection=str(error))
        return Response()

    @property
    def needs_commands(self) -> bool:
        """Whether the ticks carry neither speeds nor efforts of the wheels."""
        return self.estimator.driven_by in (BY_COMMAND, BY_NOTHING)

    def _tick(self, stamp_ns: int, names: Sequence[str], velocity: Sequence[float],
              effort: Sequence[float]) -> Response:
        # In lock-step, a tick is repeated when its response was lost.
        if self._last is None or self._last[0] != stamp_ns:
            try:
                if tuple(names) != FLYWHEEL_NAMES:
                    error = RejectedError(
                        'wheels', f'the names must be {", ".join(FLYWHEEL_NAMES)}')
                    self.estimator.reject(error)
                    raise error
                self._last = stamp_ns, self.estimator.tick(stamp_ns, velocity, effort)
            except RejectedError as error:
                return Response((OutputMessage(ESTIMATE_WAITING, stamp_ns),), str(error))
        return Response(_messages(self.estimator, *self._last))


def _messages(estimator: Estimator, stamp_ns: int, estimate: Estimate | None
              ) -> Iterator[OutputMessage]:
    """Make the messages for an estimate, or for a tick without estimate."""
    if estimate is None:
        yield OutputMessage(ESTIMATE_WAITING, stamp_ns)
        return

    def message(topic: str, names: Iterable[str], *values: Array) -> OutputMessage:
        return OutputMessage(topic, stamp_ns, tuple(names), values)
    yield message(ESTIMATE_LINK_STATES, LINK_NAMES, estimate.link_angles, estimate.link_rates,
                  estimate.link_torques)
    yield message(ESTIMATE_SIGMA, LINK_NAMES, estimate.angle_sigmas, estimate.rate_sigmas)
    yield message(ESTIMATE_COVARIANCE, COVARIANCES, estimate.covariance[_UPPER])
    yield message(ESTIMATE_DISTURBANCE, DISTURBANCES,
                  np.concatenate([estimate.disturbance, estimate.disturbance_sigmas]))
    if biases := estimate.gyro_biases:
        yield message(ESTIMATE_GYRO_BIAS, map(sensor_name, biases),
                      np.array(list(biases.values())))
    if statuses := estimator.sample_statuses():
        # Contiguous rows, as serialisers need them.
        sensors, codes, nis = np.array(statuses, float).T.copy()
        yield message(ESTIMATE_DECISIONS, (sensor_name(int(sensor)) for sensor in sensors), codes,
                      nis, (codes == ACCEPTED).astype(float))
    if (innovation := estimate.innovation) is not None:
        yield message(
            ESTIMATE_INNOVATION,
            ('nis', 'degrees_of_freedom', *map(sensor_name, innovation.sensors)),
            np.array([innovation.nis, innovation.degrees_of_freedom, *innovation.values]))
