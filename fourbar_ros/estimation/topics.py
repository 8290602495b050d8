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

MEASURED, TICK, COMMAND = 'link_angles', 'flywheel_states', 'flywheel_command'
INPUTS = (MEASURED, TICK)
"""Topics that the estimator subscribes to, all JointState; to COMMAND only where it must."""


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


STATES, INNOVATION = 'estimate/link_states', 'estimate/innovation'
OUTPUTS = {
    STATES: Output(LINK_NAMES, ('position', 'velocity', 'effort'), frame='table'),
    'estimate/sigma': Output(LINK_NAMES),
    'estimate/covariance': Output(COVARIANCES, ('position',)),
    'estimate/disturbance': Output(DISTURBANCES, ('position',)),
    'estimate/gyro_bias': Output(LINK_NAMES, ('velocity',), optional=True),
    'estimate/decisions': Output(LINK_NAMES, ('position', 'velocity', 'effort')),
    INNOVATION: Output(('nis', 'degrees_of_freedom', *LINK_NAMES), ('position',)),
}
WAITING = 'estimate/waiting'
"""The topic, of type Header, that answers a tick for which there is no estimate."""


class Message(NamedTuple):
    """
    What is to be published.

    :param topic: of `OUTPUTS`, or `WAITING`, which has a stamp and nothing else.
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

        :param topic: one of `INPUTS`, or COMMAND.
        :param stamp_ns: of the header [ns].
        :param names, position, velocity, effort: as they are in the message.
        """
        if topic == TICK:
            return self._tick(stamp_ns, names, velocity, effort)
        if topic == COMMAND:
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
            return Answer((Message(WAITING, stamp_ns),), str(error))
        self._last = stamp_ns, estimate
        return Answer(messages_of(self.estimator, stamp_ns, estimate))


def messages_of(estimator: Estimator, stamp_ns: int, estimate: Estimate | None
                ) -> Iterator[Message]:
    """
    Say what the estimate of a tick is, or that there is none: either answers a lock-step.

    :param estimator: at that tick.
    """
    if estimate is None:
        yield Message(WAITING, stamp_ns)
        return
    yield Message(STATES, stamp_ns, LINK_NAMES, (
        estimate.link_angles, estimate.link_rates, estimate.link_torques))
    yield Message('estimate/sigma', stamp_ns, LINK_NAMES,
                  (estimate.angle_sigmas, estimate.rate_sigmas))
    yield Message('estimate/covariance', stamp_ns, COVARIANCES, (estimate.covariance[UPPER],))
    yield Message('estimate/disturbance', stamp_ns, DISTURBANCES, (
        np.concatenate([estimate.disturbance, estimate.disturbance_sigmas]),))
    if estimate.gyro_biases:
        yield Message('estimate/gyro_bias', stamp_ns,
                      tuple(SENSOR_NAMES[sensor] for sensor in estimate.gyro_biases), (
                          np.array(list(estimate.gyro_biases.values())),))
    if decisions := estimator.decisions():
        sensors, reasons, squares = zip(*decisions)
        accepted = np.array(reasons) == ACCEPTED
        yield Message('estimate/decisions', stamp_ns,
                      tuple(SENSOR_NAMES[sensor] for sensor in sensors), (
                          np.array(reasons, float), np.array(squares), accepted.astype(float)))
    if (seen := estimate.innovation) is not None:
        names = ('nis', 'degrees_of_freedom', *map(sensor_name, seen.sensors))
        yield Message(INNOVATION, stamp_ns, names, (
            np.array([seen.nis, seen.degrees_of_freedom, *seen.values]),))
