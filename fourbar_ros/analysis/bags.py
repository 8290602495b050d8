# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Read rosbag2 directories (MCAP or SQLite) into numpy arrays, without ROS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from fourbar_ros.analysis.bag_reader import (
    absolute_name,
    bag_error,
    BagError,
    check_directory,
    DIAGNOSTIC_STATUS,
    JOINT_STATE,
    open_bag,
)
from fourbar_ros.common.names import ESTIMATE_LINK_STATES, SIM_FLYWHEEL_STATES, SIM_LINK_STATES
from fourbar_ros.common.progress import no_progress, Progress
import numpy as np
from numpy.typing import NDArray

# /sim/flywheel_states is not the flywheel_states of a suite in the namespace /sim, unless the
# caller selects that namespace.
_LONGER_NAMES = (SIM_LINK_STATES, SIM_FLYWHEEL_STATES, ESTIMATE_LINK_STATES)
# Longest interval between messages that is interpolated, in median intervals.
LARGEST_GAP = 3.0

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
_FIELDS = ('position', 'velocity', 'effort')


@dataclass(frozen=True)
class JointSeries:
    """
    The n messages of one JointState topic as arrays; a value that a message lacks is NaN.

    :param topic: absolute name.
    :param stamp_ns: (n,) header stamps [ns].
    :param received_ns: (n,) recorder time [ns]; use it for the order of messages only.
    :param names: the k joint names that occur.
    :param position: (n, k) [rad].
    :param velocity: (n, k) [rad/s].
    :param effort: (n, k) [N m].
    """

    topic: str
    stamp_ns: Nanoseconds
    received_ns: Nanoseconds
    names: tuple[str, ...]
    position: Floats
    velocity: Floats
    effort: Floats

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamp_ns)

    def rows(self, index: Any) -> JointSeries:
        """Return the messages at a numpy index."""
        return replace(self, **{name: getattr(self, name)[index]
                                for name in ('stamp_ns', 'received_ns', *_FIELDS)})

    def by_stamp(self) -> JointSeries:
        """Return the messages in order of stamps; of equal stamps the first to arrive."""
        return self.rows(np.unique(self.stamp_ns, return_index=True)[1])

    def between(self, start_ns: int, end_ns: int) -> JointSeries:
        """Return the messages with start_ns <= stamp <= end_ns."""
        return self.rows((self.stamp_ns >= start_ns) & (self.stamp_ns <= end_ns))

    def interpolated(self, stamp_ns: Nanoseconds) -> JointSeries:
        """
        Return values at other stamps, by linear interpolation.

        :param stamp_ns: (m,) stamps [ns]. A stamp before the first message, after the last, or
            in an interval longer than `LARGEST_GAP` is left out.
        """
        intervals = np.diff(self.stamp_ns)
        after = np.searchsorted(self.stamp_ns, stamp_ns)
        inside = (after > 0) & (after < len(self))
        if inside.any():
            inside[inside] = intervals[after[inside] - 1] <= LARGEST_GAP * np.median(intervals)
        stamps = stamp_ns[inside]
        # Relative to the first stamp: nanoseconds since 1970 exceed the precision of a double.
        known, wanted = self.stamp_ns - self.stamp_ns[0], stamps - self.stamp_ns[0]
        position, velocity, effort = (
            np.column_stack([np.interp(wanted, known, column) for column in array.T])
            for array in (np.unwrap(self.position, axis=0), self.velocity, self.effort))
        return JointSeries(self.topic, stamps, self.received_ns[after[inside]], self.names,
                           position, velocity, effort)

    def select(self, names: Sequence[str]) -> JointSeries:
        """Return these columns in this order; a name that never occurs gives NaN."""
        columns = [self.names.index(name) if name in self.names else -1 for name in names]
        missing = np.full(len(self), np.nan)
        arrays = (np.column_stack([array, missing])[:, columns]
                  for array in (self.position, self.velocity, self.effort))
        return JointSeries(self.topic, self.stamp_ns, self.received_ns, tuple(names), *arrays)


@dataclass(frozen=True)
class Bag:
    """
    The JointState and DiagnosticStatus messages of a bag.

    :param path: the directory.
    :param namespace: of the suite in the bag; None: found from the topic names.
    :param started_ns: recorder time of the first message [ns since 1970].
    :param duration_s: recorder time from the first message to the last [s].
    :param message_count: of all topics and types.
    :param topics: message type by absolute topic name.
    :param counts: number of messages by absolute topic name.
    :param messages: recorder time [ns] and message, by absolute topic name.
    """

    path: Path
    namespace: str | None
    started_ns: int
    duration_s: float
    message_count: int
    topics: Mapping[str, str]
    counts: Mapping[str, int]
    messages: Mapping[str, list[tuple[int, Any]]]

    @cached_property
    def _series(self) -> dict[str, JointSeries]:
        return {}

    def has(self, name: str) -> bool:
        """
        Return whether the bag has messages of a topic, of any type.

        :raises BagError: the topic exists in more than one namespace.
        """
        try:
            return bool(self.messages[self._resolve(name)])
        except BagError as error:
            if error.values['reason'] == 'ambiguous':
                raise
            return False

    def arrivals(self, name: str) -> JointSeries:
        """
        Return a JointState topic in order of reception.

        :param name: relative, such as ``estimate/link_states``.
        :raises BagError: no such topic, more than one, another type, or no message.
        """
        topic = self._checked(name, JOINT_STATE)
        if topic not in self._series:
            self._series[topic] = _joint_series(topic, self.messages[topic])
        return self._series[topic]

    def joint_states(self, name: str) -> JointSeries:
        """Return a JointState topic in order of stamps, each stamp once; see `arrivals`."""
        return self.arrivals(name).by_stamp()

    def statuses(self, name: str) -> list[dict[str, str]]:
        """
        Return the values by key of each message of a DiagnosticStatus topic.

        :raises BagError: as :meth:`arrivals`.
        """
        return [{item.key: item.value for item in message.values}
                for _, message in self.messages[self._checked(name, DIAGNOSTIC_STATUS)]]

    def last_status(self, name: str, key: str) -> str:
        """Return the last value of a key that is not empty, '' without topic or value."""
        values = self.statuses(name) if self.has(name) else []
        return next((value for status in reversed(values) if (value := status.get(key))), '')

    def _checked(self, name: str, type_name: str) -> str:
        topic = self._resolve(name)
        if self.topics[topic] != type_name:
            raise bag_error(self.path, 'type', f': {topic} is {self.topics[topic]}, not '
                            f'{type_name}', topic=topic, value=self.topics[topic])
        if not self.messages[topic]:
            raise bag_error(self.path, 'no_message', f': no message on {topic}', topic=topic)
        return topic

    def _resolve(self, name: str) -> str:
        if self.namespace is not None:
            topic = absolute_name(self.namespace, name)
            matches = [topic] if topic in self.topics else []
        else:
            longer = tuple(f'/{other}' for other in _LONGER_NAMES if other.endswith(f'/{name}'))
            matches = [topic for topic in self.topics
                       if topic.endswith(f'/{name}') and not (longer and topic.endswith(longer))]
        if not matches:
            raise bag_error(self.path, 'no_topic', f': no topic {name}', topic=name)
        if len(matches) > 1:
            raise bag_error(
                self.path, 'ambiguous', f': {name} could be {" or ".join(sorted(matches))}: name '
                'the namespace', topic=name, value=sorted(matches))
        return matches[0]


def read_bag(path: str | Path, namespace: str | None = None,
             progress: Progress = no_progress) -> Bag:
    """
    Read a rosbag2 directory.

    :param namespace: of the suite, for a bag with more than one.
    :param progress: wraps the iterable of messages.
    :raises BagError: missing, no bag, not closed by its recorder, truncated or damaged.
    """
    path = Path(path)
    check_directory(path)
    with open_bag(path) as reader:
        messages: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in reader.topics}
        selected = [connection for connection in reader.connections
                    if connection.msgtype in (JOINT_STATE, DIAGNOSTIC_STATUS)]
        for connection, received_ns, data in reader.messages(selected, progress):
            messages[connection.topic].append(
                (received_ns, reader.deserialize(connection, data)))
        info = reader.info
        return Bag(path, namespace, info.start_time if info.message_count else 0,
                   info.duration * 1e-9, info.message_count, reader.topics,
                   {topic: reader.count(topic) for topic in reader.topics}, messages)


def _joint_series(topic: str, messages: list[tuple[int, Any]]) -> JointSeries:
    names = tuple(dict.fromkeys(name for _, message in messages for name in message.name))
    column = {name: index for index, name in enumerate(names)}
    arrays = np.full((3, len(messages), len(names)), np.nan)
    for row, (_, message) in enumerate(messages):
        columns = [column[name] for name in message.name]
        for array, field in zip(arrays, _FIELDS):
            values = getattr(message, field)
            # Every node rejects a message with an array of another length.
            if len(values) == len(columns):
                array[row, columns] = values
    stamps = [message.header.stamp for _, message in messages]
    return JointSeries(
        topic, np.array([stamp.sec * 10**9 + stamp.nanosec for stamp in stamps], dtype=np.int64),
        np.array([received_ns for received_ns, _ in messages], dtype=np.int64), names, *arrays)
