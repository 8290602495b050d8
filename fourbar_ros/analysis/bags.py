# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Read rosbag2 directories (MCAP or SQLite) into plain numpy arrays, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.names import ESTIMATE_LINK_STATES, SIM_FLYWHEEL_STATES, SIM_LINK_STATES
import numpy as np
from numpy.typing import NDArray

JOINT_STATE = 'sensor_msgs/msg/JointState'
DIAGNOSTIC_STATUS = 'diagnostic_msgs/msg/DiagnosticStatus'

# Relative names that end in another name of the API: /sim/flywheel_states is not the
# flywheel_states of a suite in the namespace /sim unless the caller says so.
_LONGER_NAMES = (SIM_LINK_STATES, SIM_FLYWHEEL_STATES, ESTIMATE_LINK_STATES)

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]


class BagError(FourbarError):
    """A recording that cannot be read, or that lacks what was asked of it."""


@dataclass(frozen=True)
class JointSeries:
    """
    The n messages of one JointState topic as arrays; what a message leaves out is NaN.

    :param topic: absolute name.
    :param stamp_ns: (n,) header stamps.
    :param received_ns: (n,) recorder time, good for order only.
    :param names: the k names that occur.
    :param position: (n, k); so are velocity and effort.
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
        """Return the messages that a numpy index picks."""
        return JointSeries(
            self.topic, self.stamp_ns[index], self.received_ns[index], self.names,
            self.position[index], self.velocity[index], self.effort[index])

    def by_stamp(self) -> JointSeries:
        """Return the messages in order of their stamps; of equal stamps the first to arrive."""
        return self.rows(np.unique(self.stamp_ns, return_index=True)[1])

    def between(self, start_ns: int, end_ns: int) -> JointSeries:
        """Return the messages with start_ns <= stamp <= end_ns."""
        return self.rows((self.stamp_ns >= start_ns) & (self.stamp_ns <= end_ns))

    def at(self, stamp_ns: Nanoseconds) -> JointSeries:
        """
        Return what lies between the messages, on a straight line from one to the next.

        :param stamp_ns: (m,) stamps; those before the first message or after the last are left
            out, and so are those between two that are further apart than three times the usual.
        """
        steps = np.diff(self.stamp_ns)
        after = np.searchsorted(self.stamp_ns, stamp_ns)
        inside = (after > 0) & (after < len(self))
        if inside.any():
            inside[inside] = steps[after[inside] - 1] <= 3.0 * np.median(steps)
        stamps = stamp_ns[inside]

        def between(array: Floats, turns: bool = False) -> Floats:
            continuous = np.unwrap(array, axis=0) if turns else array
            # From a stamp near by: nanoseconds since 1970 do not fit a double.
            times, wanted = self.stamp_ns - self.stamp_ns[0], stamps - self.stamp_ns[0]
            return np.column_stack([np.interp(wanted, times, column) for column in continuous.T])

        return JointSeries(
            self.topic, stamps, self.received_ns[after[inside]], self.names,
            between(self.position, turns=True), between(self.velocity), between(self.effort))

    def select(self, names: Sequence[str]) -> JointSeries:
        """Return these columns in this order, NaN for a name that never occurs."""
        def columns(array: Floats) -> Floats:
            padded = np.column_stack([array, np.full(len(self), np.nan)])
            return padded[:, [self.names.index(name) if name in self.names else -1
                              for name in names]]

        return JointSeries(
            self.topic, self.stamp_ns, self.received_ns, tuple(names),
            columns(self.position), columns(self.velocity), columns(self.effort))


@dataclass(frozen=True)
class Status:
    """One message of a DiagnosticStatus topic."""

    received_ns: int
    message: str
    values: Mapping[str, str]


@dataclass(frozen=True)
class Recording:
    """
    The JointState and DiagnosticStatus topics of one bag.

    :param path: the directory.
    :param namespace: of the suite in the bag; None: found by the names of the topics.
    :param started_ns: recorder time of the first message, since 1970.
    :param duration_s: recorder time from the first message to the last.
    :param message_count: of all topics and types.
    :param topics: type by absolute name.
    :param counts: number of messages by absolute name.
    """

    path: Path
    namespace: str | None
    started_ns: int
    duration_s: float
    message_count: int
    topics: Mapping[str, str]
    counts: Mapping[str, int]
    _messages: Mapping[str, list[tuple[int, Any]]]

    @cached_property
    def _series(self) -> dict[str, JointSeries]:
        return {}

    def has(self, name: str) -> bool:
        """Tell whether :meth:`joint_states` or :meth:`statuses` would find messages."""
        try:
            return bool(self._messages[self._resolve(name)])
        except BagError as error:
            if isinstance(error, _AmbiguousTopicError):
                raise
            return False

    def arrivals(self, name: str) -> JointSeries:
        """
        Return a JointState topic as it was received.

        :param name: relative, such as ``estimate/link_states``.
        :raises BagError: no such topic, more than one, of another type, or no message on it.
        """
        topic = self._checked(name, JOINT_STATE)
        if topic not in self._series:
            self._series[topic] = _joint_series(topic, self._messages[topic])
        return self._series[topic]

    def joint_states(self, name: str) -> JointSeries:
        """Return :meth:`arrivals` in order of stamps, each stamp once."""
        return self.arrivals(name).by_stamp()

    def statuses(self, name: str) -> list[Status]:
        """
        Return a DiagnosticStatus topic as it was received.

        :raises BagError: as :meth:`arrivals`.
        """
        return [
            Status(received_ns, message.message, {v.key: v.value for v in message.values})
            for received_ns, message in self._messages[self._checked(name, DIAGNOSTIC_STATUS)]]

    def _checked(self, name: str, type_name: str) -> str:
        topic = self._resolve(name)
        if self.topics[topic] != type_name:
            raise BagError(f'{self.path}: {topic} is {self.topics[topic]}, not {type_name}')
        if not self._messages[topic]:
            raise BagError(f'{self.path}: no message on {topic}')
        return topic

    def _resolve(self, name: str) -> str:
        if self.namespace is not None:
            topic = '/'.join(['', *filter(None, f'{self.namespace}/{name}'.split('/'))])
            found = [topic] if topic in self.topics else []
        else:
            longer = tuple(f'/{other}' for other in _LONGER_NAMES if other.endswith(f'/{name}'))
            found = [topic for topic in self.topics
                     if topic.endswith(f'/{name}') and not (longer and topic.endswith(longer))]
        if not found:
            raise BagError(f'{self.path}: no topic {name}')
        if len(found) > 1:
            raise _AmbiguousTopicError(
                f'{self.path}: {name} could be {" or ".join(sorted(found))}: name the namespace')
        return found[0]


class _AmbiguousTopicError(BagError):
    pass


def read_bag(path: str | Path, namespace: str | None = None,
             progress: Callable[[Iterable[Any], int], Iterable[Any]] | None = None) -> Recording:
    """
    Read a rosbag2 directory.

    :param namespace: read the suite under this namespace, where the bag holds more than one.
    :param progress: wraps the iterable of messages, given also how many there are.
    :raises BagError: missing, no bag, not closed by its recorder, cut, or damaged.
    """
    path = Path(path)
    check_directory(path)
    try:
        return _read(path, namespace, progress)
    except BagError:
        raise
    except Exception as error:  # a damaged file can break any layer below: YAML, MCAP, CDR
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise BagError(f'{path} is cut or damaged: {reason}') from error


def check_directory(path: Path) -> None:
    """
    Refuse what is no rosbag2 directory.

    :raises BagError: missing, a file, or without metadata.
    """
    if not path.exists():
        raise BagError(f'{path}: no such directory')
    if not path.is_dir():
        raise BagError(f'{path} is a file: name the rosbag2 directory that holds it')
    if (path / 'metadata.yaml').is_file():
        return
    for suffix, storage in (('mcap', 'mcap'), ('db3', 'sqlite3')):
        if any(path.glob(f'*.{suffix}')):
            raise BagError(f'{path} has no metadata.yaml, its recorder was killed: repair it with '
                           f'`ros2 bag reindex -s {storage} {path}`')
    raise BagError(f'{path} is not a rosbag2 directory: it has no metadata.yaml')


def _read(path: Path, namespace: str | None, progress: Any) -> Recording:
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import get_typestore, Stores

    deserialize = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr
    messages: dict[str, list[tuple[int, Any]]] = {}
    with Reader(path) as reader:
        topics = {connection.topic: connection.msgtype for connection in reader.connections}
        chosen = [connection for connection in reader.connections
                  if connection.msgtype in (JOINT_STATE, DIAGNOSTIC_STATUS)]
        messages = {topic: [] for topic in topics}
        counts = dict.fromkeys(topics, 0)
        for connection in reader.connections:
            counts[connection.topic] += connection.msgcount
        expected = sum(connection.msgcount for connection in chosen)
        stream: Iterable[Any] = reader.messages(chosen) if chosen else ()
        for connection, received_ns, data in progress(stream, expected) if progress else stream:
            messages[connection.topic].append(
                (received_ns, deserialize(data, connection.msgtype)))
        found = sum(map(len, messages.values()))
        if found < expected:
            raise BagError(f'{path} is cut: {found} of {expected} messages are left')
        empty = reader.message_count == 0
        return Recording(
            path, namespace, 0 if empty else reader.start_time, reader.duration * 1e-9,
            reader.message_count, topics, counts, messages)


def _joint_series(topic: str, messages: list[tuple[int, Any]]) -> JointSeries:
    names = tuple(dict.fromkeys(name for _, message in messages for name in message.name))
    column = {name: index for index, name in enumerate(names)}
    arrays = np.full((3, len(messages), len(names)), np.nan)
    for row, (_, message) in enumerate(messages):
        columns = [column[name] for name in message.name]
        for array, values in zip(arrays, (message.position, message.velocity, message.effort)):
            # An array of another length belongs to a message that every node refuses.
            if len(values) == len(columns):
                array[row, columns] = values
    stamps = [message.header.stamp for _, message in messages]
    return JointSeries(
        topic, np.array([stamp.sec * 10**9 + stamp.nanosec for stamp in stamps], dtype=np.int64),
        np.array([received_ns for received_ns, _ in messages], dtype=np.int64), names, *arrays)
