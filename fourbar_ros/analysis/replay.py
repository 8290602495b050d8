# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The estimator over a recorded bag: a new bag with other estimates, and both sides by the numbers.

The messages go to the estimator in the order in which the bag has them, by the very door that the
node has (:mod:`fourbar_ros.estimation.estimator_topics`).
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TYPE_CHECKING

from fourbar_ros.analysis.bags import BagError, DIAGNOSTIC_STATUS, JOINT_STATE, JointSeries
from fourbar_ros.analysis.stored_bag import copier, open_bag, StoredBag
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.names import (
    DIAGNOSTICS,
    ESTIMATE_INNOVATION,
    ESTIMATE_LINK_STATES,
    ESTIMATE_WAITING,
    FLYWHEEL_COMMAND,
    FLYWHEEL_STATES,
    SIM_LINK_STATES,
)
from fourbar_ros.common.progress import Progress
from fourbar_ros.estimation import EstimatorSettings
from fourbar_ros.estimation.estimator_settings import PARAMETERS
from fourbar_ros.estimation.estimator_topics import EstimatorTopics, INPUTS, OutputMessage, OUTPUTS
from fourbar_ros.mechanism import LINK_NAMES, load_mechanism
import numpy as np

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

DIAGNOSTIC_ARRAY = 'diagnostic_msgs/msg/DiagnosticArray'
HEADER = 'std_msgs/msg/Header'
NODE = 'estimator'
COUNTERS = ('rejected', 'gated')


class ReplayError(FourbarError):
    """A replay that cannot be made as it was asked for."""


@dataclass
class Judgements:
    """
    What an estimator said of the samples that it got.

    :param starts: how often its filter was started.
    :param rejected: messages of no use, by kind.
    :param gated: samples that the gate refused, by sensor.
    :param faults: seconds for which a sensor was said to have a fault, by `sensor: fault`; None
        where only the fact is known.
    """

    starts: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    gated: dict[str, int] = field(default_factory=dict)
    faults: dict[str, float | None] = field(default_factory=dict)


class LinkLog:
    """Collects angle and rate of the four links, and joins them to arrays."""

    def __init__(self) -> None:
        self._stamps, self._values = array('q'), array('d')

    def add(self, stamp_ns: int, names: Sequence[str], position: Sequence[float],
            velocity: Sequence[float]) -> None:
        """Take a message; what it leaves out, or has at odd lengths, is NaN."""
        self._stamps.append(stamp_ns)
        for values in (position, velocity):
            if len(values) != len(names):
                self._values.extend([np.nan] * 4)
            elif tuple(names) == LINK_NAMES:
                self._values.extend(values)
            else:
                known = dict(zip(names, values))
                self._values.extend(known.get(name, np.nan) for name in LINK_NAMES)

    def series(self, topic: str) -> JointSeries:
        """Return what came in the order of stamps, each once."""
        stamps = np.array(self._stamps, dtype=np.int64)
        values = np.array(self._values).reshape(-1, 2, 4)
        return JointSeries(topic, stamps, stamps, LINK_NAMES, values[:, 0], values[:, 1],
                           np.full((len(stamps), 4), np.nan)).by_stamp()


class NisLog:
    """Collects the NIS of updates with their degrees of freedom."""

    def __init__(self) -> None:
        self._stamps, self._values = array('q'), array('d')

    def add(self, stamp_ns: int, names: Sequence[str], position: Sequence[float]) -> None:
        """Take a message of `estimate/innovation`."""
        known = dict(zip(names, position))
        self._stamps.append(stamp_ns)
        self._values.extend(known.get(name, np.nan) for name in ('nis', 'degrees_of_freedom'))

    def rows(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return stamp [ns], NIS and degrees of freedom of updates that used a sample, (n, 3)."""
        rows = np.column_stack([
            np.array(self._stamps, dtype=float), np.array(self._values).reshape(-1, 2)])
        return rows[rows[:, 2] > 0]


@dataclass
class Side:
    """
    One of the two estimators.

    :param states: what it published as `estimate/link_states`.
    :param nis: what it published as `estimate/innovation`.
    :param judgements: None where the bag does not tell.
    """

    states: LinkLog = field(default_factory=LinkLog)
    nis: NisLog = field(default_factory=NisLog)
    judgements: Judgements | None = None


@dataclass(frozen=True)
class Replay:
    """
    What came of a replay.

    :param bag: the recording.
    :param namespace: of the suite in it, '' or as '/table1'.
    :param mechanism: preset or path.
    :param settings: of the estimator, by name.
    :param ticks_ns: (n,) stamps of the ticks, each once [ns].
    :param waiting: number of ticks without an estimate.
    :param recorded, replayed: the two sides.
    :param truth: `sim/link_states` of the bag.
    :param warnings: what the new bag lacks.
    """

    bag: Path
    namespace: str
    mechanism: str
    settings: Mapping[str, Any]
    ticks_ns: list[int]
    waiting: int
    recorded: Side
    replayed: Side
    truth: LinkLog
    warnings: list[str]


def replay(bag: str | Path, output: Path, values: Mapping[str, Any], *,
           namespace: str | None = None, progress: Progress | None = None) -> Replay:
    """
    Run the estimator over a bag, and write a new one (MCAP).

    It holds all that the old one does, with the estimates in place of those that were recorded,
    at the log times of the ticks that they answer. After an error a part of it may be there.

    :param bag: rosbag2 directory, or its single file.
    :param output: directory to make.
    :param values: some of the estimator's parameters by name; the others have their defaults,
        `mechanism` that which the device names in the bag.
    :param namespace: of the suite, for a bag that holds more than one.
    :param progress: wraps the iterable of messages, given also how many there are.
    :raises FourbarError: a bag that cannot be read or that lacks what the estimator needs, a
        value that is refused, an unknown mechanism.
    :raises OSError: the new bag cannot be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    with ExitStack() as stack:
        stored = stack.enter_context(open_bag(bag))
        chosen = find_namespace(stored, namespace)
        parameters = checked_values(values)
        if 'mechanism' not in values:
            parameters['mechanism'] = _recorded_mechanism(stored, chosen) or (
                parameters['mechanism'])
        mechanism = parameters.pop('mechanism')
        run = _Run(stored, chosen, EstimatorTopics(
            load_mechanism(mechanism), EstimatorSettings(**parameters)))
        writer = Writer(output, version=9, storage_plugin=StoragePlugin.MCAP)
        run.write_to(stack.enter_context(writer), progress)
        return Replay(Path(bag), chosen, mechanism, parameters, run.ticks_ns, run.waiting,
                      run.recorded, run.replayed, run.truth, run.warnings)


def checked_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the values of all parameters of the estimator, those that are not given by default.

    :raises FourbarError: one of them is unknown, of the wrong type, or out of range.
    """
    rows = {row.name: row for row in PARAMETERS}
    if unknown := sorted(set(values) - set(rows)):
        raise ReplayError(f'unknown setting {", ".join(unknown)} (known are {", ".join(rows)})')
    return {name: row.check(values.get(name, row.default)) for name, row in rows.items()}


def find_namespace(stored: StoredBag, wanted: str | None = None) -> str:
    """
    Find the suite in a bag whose estimator there is something for.

    :param wanted: its namespace, as '/table1' or 'table1'.
    :returns: '' or a name that begins with '/'.
    :raises BagError: there is none, more than one, or its topics have another type.
    """
    topics = stored.topics
    found = sorted({
        topic[:-len(name) - 1] for topic in topics for name in INPUTS
        # Ground truth is no measurement, unless somebody has a suite of that name.
        if topic.endswith(f'/{name}') and (wanted or not topic.endswith(f'/sim/{name}'))})
    whole = [space for space in found if all(f'{space}/{name}' in topics for name in INPUTS)]
    if wanted is not None:
        chosen = '/'.join(['', *filter(None, wanted.split('/'))]).rstrip('/')
        if chosen not in whole and chosen not in found:
            others = ', '.join(
                space or '/' for space in found if not space.endswith('/sim'))
            raise BagError(f'{stored.path}: nothing in the namespace {chosen or "/"}: '
                           + (f'there are {others}' if others else _what_it_has(topics)))
    else:
        spaces = whole or found
        if len(spaces) > 1:
            raise BagError(f'{stored.path} holds more than one suite: choose a namespace of '
                           f'{", ".join(space or "/" for space in spaces)}')
        chosen = spaces[0] if spaces else ''
    for name in INPUTS:
        topic = f'{chosen}/{name}'
        counts = [connection.msgcount for connection in stored.connections
                  if connection.topic == topic]
        if not counts:
            raise BagError(f'{stored.path}: no topic {topic}: {_what_it_has(topics)}')
        if not any(counts):
            raise BagError(f'{stored.path}: no message on {topic}')
    for name in (*INPUTS, FLYWHEEL_COMMAND, ESTIMATE_LINK_STATES, ESTIMATE_INNOVATION,
                 SIM_LINK_STATES):
        kind = topics.get(f'{chosen}/{name}', JOINT_STATE)
        if kind != JOINT_STATE:
            raise BagError(f'{stored.path}: {chosen}/{name} is {kind}, not {JOINT_STATE}')
    return chosen


def _what_it_has(topics: Mapping[str, str]) -> str:
    return f'it has {", ".join(sorted(topics))}'


def _recorded_mechanism(stored: StoredBag, namespace: str) -> str | None:
    """Return the mechanism that the device names in the bag, the last one if it does often."""
    name = None
    connections = [connection for connection in stored.connections
                   if connection.topic == f'{namespace}/device_status'
                   and connection.msgtype == DIAGNOSTIC_STATUS]
    for connection, _, data in stored.messages(connections):
        for pair in stored.content(connection, data).values:
            if pair.key == 'mechanism' and pair.value:
                name = str(pair.value)
    if name is not None:
        try:
            load_mechanism(name)
        except FourbarError as error:
            raise ReplayError(f'the mechanism that the bag names is not to be had, give another: '
                              f'{error}') from error
    return name


class _Run:
    """One pass over a bag."""

    def __init__(self, stored: StoredBag, namespace: str, topics: EstimatorTopics) -> None:
        self.ticks_ns: list[int] = []
        self.waiting = 0
        self.recorded, self.replayed, self.truth = Side(), Side(), LinkLog()
        self.warnings: list[str] = []
        self._stored = stored
        self._topics = topics
        self._namespace = namespace
        self._relative = {f'{namespace}/{name}': name for name in (
            *INPUTS, FLYWHEEL_COMMAND, *OUTPUTS, ESTIMATE_WAITING, SIM_LINK_STATES)}
        self._faults: Counter[str] = Counter()
        self._seen_faults: dict[str, float | None] = {}

    def write_to(self, writer: Any, progress: Progress | None) -> None:
        """Go through all messages and write the new bag."""
        copy = copier(writer, self.warnings.append)
        publish = _Publisher(writer, self._namespace, self._stored.connections)
        copies = [connection for connection in self._stored.connections
                  if self._relative.get(connection.topic) not in (*OUTPUTS, ESTIMATE_WAITING)]
        for connection in copies:
            copy(connection)
        stream: Any = self._stored.messages()
        total = sum(connection.msgcount for connection in self._stored.connections)
        for connection, logged_ns, data in progress(stream, total) if progress else stream:
            name = self._relative.get(connection.topic)
            if name not in OUTPUTS and name != ESTIMATE_WAITING:
                writer.write(copy(connection), logged_ns, data)
            if connection.topic == DIAGNOSTICS and connection.msgtype == DIAGNOSTIC_ARRAY:
                self._diagnosed(self._stored.content(connection, data))
            elif name in (*INPUTS, ESTIMATE_LINK_STATES, ESTIMATE_INNOVATION, SIM_LINK_STATES) or (
                    name == FLYWHEEL_COMMAND and self._topics.needs_commands):
                for answer in self._take(name, self._stored.content(connection, data)):
                    publish(answer, logged_ns)
        self._conclude()

    def _take(self, name: str, message: Any) -> tuple[OutputMessage, ...]:
        """Note a message, and hand it to the estimator if it is for it."""
        stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        if name in (ESTIMATE_LINK_STATES, SIM_LINK_STATES):
            log = self.recorded.states if name == ESTIMATE_LINK_STATES else self.truth
            log.add(stamp_ns, message.name, message.position, message.velocity)
            return ()
        if name == ESTIMATE_INNOVATION:
            self.recorded.nis.add(stamp_ns, message.name, message.position)
            return ()
        answer = self._topics.receive(name, stamp_ns, message.name, message.position,
                                      message.velocity, message.effort)
        messages = tuple(answer.messages)
        if name == FLYWHEEL_STATES and not answer.rejection and (
                not self.ticks_ns or self.ticks_ns[-1] != stamp_ns):
            self._note_tick(stamp_ns, messages)
        return messages

    def _note_tick(self, stamp_ns: int, messages: tuple[OutputMessage, ...]) -> None:
        self.ticks_ns.append(stamp_ns)
        for message in messages:
            if message.topic == ESTIMATE_LINK_STATES:
                angles, rates = (values.tolist() for values in message.values[:2])
                self.replayed.states.add(stamp_ns, message.names, angles, rates)
            elif message.topic == ESTIMATE_INNOVATION:
                self.replayed.nis.add(stamp_ns, message.names, message.values[0].tolist())
            elif message.topic == ESTIMATE_WAITING:
                self.waiting += 1
        self._faults.update(f'{sensor}: {fault}' for sensor, fault in
                            self._topics.estimator.sensor_faults().items())

    def _diagnosed(self, message: Any) -> None:
        """Note what the recorded estimator said of its samples; the last word counts."""
        for status in message.status:
            if status.name != f'{self._namespace}/{NODE}'.lstrip('/'):
                continue
            values = {pair.key: pair.value for pair in status.values}
            for fault in filter(None, values.get('sensor_faults', '').split(', ')):
                self._seen_faults.setdefault(fault, None)
            found = Judgements(_count(values.get('starts')), faults=self._seen_faults)
            for kind in COUNTERS:
                getattr(found, kind).update(
                    (key[len(kind) + 1:], _count(value)) for key, value in values.items()
                    if key.startswith(f'{kind}_'))
            self.recorded.judgements = found

    def _conclude(self) -> None:
        estimator = self._topics.estimator
        periods = np.diff(np.array(self.ticks_ns, dtype=np.int64))
        period = float(np.median(periods)) * 1e-9 if len(periods) else 0.0
        self.replayed.judgements = Judgements(
            estimator.starts, dict(estimator.rejected), dict(estimator.gated),
            {fault: count * period for fault, count in self._faults.items()})


def _count(text: str | None) -> int:
    return int(text) if text is not None and text.isdecimal() else 0


class _Publisher:
    """Writes what the estimator says into a bag."""

    def __init__(self, writer: Any, namespace: str, recorded: Sequence[Connection]) -> None:
        from rosbags.typesys import get_typestore, Stores

        self._writer = writer
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._namespace = namespace
        self._connections: dict[str, Any] = {}
        # As they were offered to the recorder.
        self._offered: dict[str, Any] = {
            connection.topic: connection.ext for connection in recorded}
        for name in (*OUTPUTS, ESTIMATE_WAITING):
            if name == ESTIMATE_WAITING or not OUTPUTS[name].optional:
                self._offer(name)

    def _offer(self, name: str) -> None:
        topic, offered = f'{self._namespace}/{name}', self._offered
        profiles = offered[topic].offered_qos_profiles if topic in offered else ()
        self._connections[name] = self._writer.add_connection(
            topic, HEADER if name == ESTIMATE_WAITING else JOINT_STATE, typestore=self._store,
            offered_qos_profiles=profiles)

    def __call__(self, message: OutputMessage, logged_ns: int) -> None:
        """Write one message."""
        if message.topic not in self._connections:
            self._offer(message.topic)
        types = self._store.types
        sec, nanosec = divmod(message.stamp_ns, 1_000_000_000)
        stamp = types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
        frame = OUTPUTS[message.topic].frame if message.topic in OUTPUTS else ''
        content = types[HEADER](stamp=stamp, frame_id=frame)
        kind = HEADER
        if message.topic in OUTPUTS:
            kind = JOINT_STATE
            arrays = {name: np.empty(0) for name in ('position', 'velocity', 'effort')}
            arrays.update(zip(OUTPUTS[message.topic].fields, message.values))
            content = types[kind](header=content, name=list(message.names), **arrays)
        self._writer.write(self._connections[message.topic], logged_ns,
                           self._store.serialize_cdr(content, kind))
