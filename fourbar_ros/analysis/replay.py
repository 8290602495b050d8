# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Replay of the estimator over a bag: a new bag with the new estimates, and both sets of estimates.

The estimator receives the messages in the order of the bag, through the same interface as in its
node (:mod:`fourbar_ros.estimation.estimator_topics`).
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TYPE_CHECKING

from fourbar_ros.analysis.bag_reader import (
    absolute_name,
    bag_error,
    BagReader,
    connection_copier,
    DIAGNOSTIC_STATUS,
    JOINT_STATE,
    open_bag,
)
from fourbar_ros.analysis.bags import JointSeries
from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.progress import no_progress, Progress
from fourbar_ros.common.settings import check_keys
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
# Outputs of the recorded estimator, and ground truth.
LOGGED = (names.ESTIMATE_LINK_STATES, names.ESTIMATE_INNOVATION, names.SIM_LINK_STATES)
NIS_NAMES = ('nis', 'degrees_of_freedom')


class ReplayError(FourbarError):
    """A replay that is not possible with these arguments; `values` hold `reason`."""


@dataclass
class EstimatorCounters:
    """
    Counters of an estimator over a replay.

    :param starts: number of starts of the filter.
    :param rejected: rejected messages by kind.
    :param gated: samples outside the gate, by sensor.
    :param faults: duration of each sensor fault by `sensor: fault` [s], None if unknown.
    """

    starts: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    gated: dict[str, int] = field(default_factory=dict)
    faults: dict[str, float | None] = field(default_factory=dict)


class JointStateLog:
    """Collects position and velocity of named values of JointState messages."""

    def __init__(self, columns: Sequence[str]) -> None:
        self._columns = tuple(columns)
        self._stamps, self._values = array('q'), array('d')

    def add(self, stamp_ns: int, joints: Sequence[str], position: Sequence[float],
            velocity: Sequence[float] = ()) -> None:
        """Add a message; a value that is missing, or in an array of wrong length, is NaN."""
        self._stamps.append(stamp_ns)
        for values in (position, velocity):
            by_name = dict(zip(joints, values)) if len(values) == len(joints) else {}
            self._values.extend(by_name.get(name, np.nan) for name in self._columns)

    def series(self, topic: str) -> JointSeries:
        """Return the messages in order of arrival."""
        stamps = np.array(self._stamps, dtype=np.int64)
        values = np.array(self._values).reshape(-1, 2, len(self._columns))
        return JointSeries(topic, stamps, stamps, self._columns, values[:, 0], values[:, 1],
                           np.full((len(stamps), len(self._columns)), np.nan))


@dataclass
class EstimatorRecord:
    """
    Output of one of the two estimators.

    :param states: its `estimate/link_states`.
    :param innovations: NIS and degrees of freedom of its `estimate/innovation`.
    :param counters: None if the bag has none.
    """

    states: JointStateLog = field(default_factory=lambda: JointStateLog(LINK_NAMES))
    innovations: JointStateLog = field(default_factory=lambda: JointStateLog(NIS_NAMES))
    counters: EstimatorCounters | None = None

    def nis(self) -> tuple[Any, Any, Any]:
        """Return stamps [ns], NIS and degrees of freedom of updates with a sample, (n,) each."""
        series = self.innovations.series(names.ESTIMATE_INNOVATION)
        used = series.rows(series.position[:, 1] > 0)
        return used.stamp_ns, used.position[:, 0], used.position[:, 1]


@dataclass
class ReplayResult:
    """
    Result of a replay.

    :param bag: the replayed bag.
    :param namespace: of the suite in the bag, '' or as '/table1'.
    :param mechanism: preset or path.
    :param settings: of the estimator, by name.
    :param ticks_ns: (n,) stamps of the ticks, each once [ns].
    :param waiting: number of ticks without an estimate.
    :param recorded, replayed: output of the estimator in the bag, and in the replay.
    :param truth: `sim/link_states` of the bag.
    :param warnings: data that the new bag lacks.
    """

    bag: Path
    namespace: str
    mechanism: str
    settings: Mapping[str, Any]
    ticks_ns: list[int] = field(default_factory=list)
    waiting: int = 0
    recorded: EstimatorRecord = field(default_factory=EstimatorRecord)
    replayed: EstimatorRecord = field(default_factory=EstimatorRecord)
    truth: JointStateLog = field(default_factory=lambda: JointStateLog(LINK_NAMES))
    warnings: list[str] = field(default_factory=list)


def replay(bag: str | Path, output: Path, values: Mapping[str, Any], *,
           namespace: str | None = None, progress: Progress = no_progress) -> ReplayResult:
    """
    Run the estimator over a bag, and write a new bag (MCAP).

    The new bag has all messages of the old one, with the new estimates in place of the recorded
    ones, at the log times of their ticks. After an error an incomplete new bag may exist.

    :param bag: rosbag2 directory, or its single storage file.
    :param output: directory to create.
    :param values: parameters of the estimator by name. Other parameters have their defaults,
        `mechanism` the value of the device status in the bag.
    :param namespace: of the suite, for a bag with more than one.
    :param progress: wraps the iterable of messages.
    :raises FourbarError: a bag that cannot be read or lacks an input of the estimator, a refused
        value, an unknown mechanism.
    :raises OSError: the new bag cannot be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    path = Path(bag)
    with ExitStack() as stack:
        reader = stack.enter_context(open_bag(path))
        selected = find_namespace(reader, namespace)
        parameters = check_parameters(values)
        if 'mechanism' not in values:
            parameters['mechanism'] = _recorded_mechanism(reader, selected) or (
                parameters['mechanism'])
        mechanism = parameters.pop('mechanism')
        result = ReplayResult(path, selected, mechanism, parameters)
        estimator = EstimatorTopics(load_mechanism(mechanism), EstimatorSettings(**parameters))
        writer = stack.enter_context(
            Writer(output, version=9, storage_plugin=StoragePlugin.MCAP))
        _Replay(reader, result, estimator).run(writer, progress)
        return result


def check_parameters(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the values of all parameters of the estimator; missing values have their defaults.

    :raises FourbarError: an unknown parameter, or a value of the wrong type or out of range.
    """
    rows = {row.name: row for row in PARAMETERS}
    check_keys(values, (), 'settings of the estimator', ReplayError, optional=rows)
    return {name: row.check(values.get(name, row.default)) for name, row in rows.items()}


def find_namespace(reader: BagReader, requested: str | None = None) -> str:
    """
    Find the namespace of the suite in a bag, and check the inputs of the estimator in it.

    :param requested: namespace, as '/table1' or 'table1'.
    :returns: '' or a name that begins with '/'.
    :raises BagError: no suite, more than one, a topic of another type or without message.
    """
    path, topics = reader.path, reader.topics
    present = {topic[:-len(name) - 1] for topic in topics for name in INPUTS
               if topic.endswith(f'/{name}')}
    # sim/flywheel_states is ground truth, unless a suite has the namespace /sim.
    suites = sorted(space for space in present if not space.endswith('/sim'))
    available = f'it has {", ".join(sorted(topics))}'
    if requested is not None:
        namespace = absolute_name(requested).rstrip('/')
        if namespace not in present:
            listed = ', '.join(space or '/' for space in suites)
            raise bag_error(path, 'no_topic', f': no suite in the namespace {namespace or "/"}: '
                            + (f'there are {listed}' if listed else available),
                            topic=namespace, value=suites)
    else:
        complete = [space for space in suites
                    if all(f'{space}/{name}' in topics for name in INPUTS)]
        namespace, *others = complete or suites or ['']
        if others:
            raise bag_error(path, 'ambiguous', ' holds more than one suite: select one of the '
                            f'namespaces {", ".join(space or "/" for space in suites)}',
                            value=complete or suites)
    for name in INPUTS:
        topic = f'{namespace}/{name}'
        if topic not in topics:
            raise bag_error(path, 'no_topic', f': no topic {topic}: {available}', topic=topic)
        if not reader.count(topic):
            raise bag_error(path, 'no_message', f': no message on {topic}', topic=topic)
    for name in (*INPUTS, names.FLYWHEEL_COMMAND, *LOGGED):
        topic = f'{namespace}/{name}'
        if (kind := topics.get(topic, JOINT_STATE)) != JOINT_STATE:
            raise bag_error(path, 'type', f': {topic} is {kind}, not {JOINT_STATE}',
                            topic=topic, value=kind)
    return namespace


def _recorded_mechanism(reader: BagReader, namespace: str) -> str | None:
    """Return the mechanism of the last device status that names one."""
    name = None
    connections = [connection for connection in reader.connections
                   if connection.topic == f'{namespace}/{names.DEVICE_STATUS}'
                   and connection.msgtype == DIAGNOSTIC_STATUS]
    for connection, _, data in reader.messages(connections):
        for item in reader.deserialize(connection, data).values:
            if item.key == 'mechanism' and item.value:
                name = str(item.value)
    if name is not None:
        try:
            load_mechanism(name)
        except FourbarError as error:
            raise ReplayError(f'the mechanism that the bag names is not available, give another '
                              f'with --mechanism: {error}', reason='mechanism', name=name
                              ) from error
    return name


class _Replay:
    """One pass over a bag."""

    def __init__(self, reader: BagReader, result: ReplayResult, topics: EstimatorTopics) -> None:
        self._reader = reader
        self._result = result
        self._topics = topics
        self._relative_names = {f'{result.namespace}/{name}': name for name in (
            *INPUTS, names.FLYWHEEL_COMMAND, *OUTPUTS, names.ESTIMATE_WAITING, *LOGGED)}
        self._logs = dict(zip(LOGGED, (
            result.recorded.states, result.recorded.innovations, result.truth)))
        self._fault_ticks: Counter[str] = Counter()

    def run(self, writer: Any, progress: Progress) -> None:
        """Process all messages, and write the new bag."""
        reader, outputs = self._reader, (*OUTPUTS, names.ESTIMATE_WAITING)
        copy = connection_copier(writer, self._result.warnings.append)
        publish = _EstimateWriter(writer, self._result.namespace, reader.connections)
        for connection in reader.connections:
            if self._relative_names.get(connection.topic) not in outputs:
                copy(connection)
        for connection, logged_ns, data in reader.messages(progress=progress):
            name = self._relative_names.get(connection.topic, '')
            if name not in outputs:
                writer.write(copy(connection), logged_ns, data)
            if connection.topic == names.DIAGNOSTICS and connection.msgtype == DIAGNOSTIC_ARRAY:
                self._read_diagnostics(reader.deserialize(connection, data))
            elif name in (*INPUTS, *LOGGED) or (
                    name == names.FLYWHEEL_COMMAND and self._topics.needs_commands):
                for message in self._receive(name, reader.deserialize(connection, data)):
                    publish(message, logged_ns)
        self._finish()

    def _receive(self, name: str, message: Any) -> tuple[OutputMessage, ...]:
        """Log a recorded output, or return the estimator's answer to an input."""
        result = self._result
        stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        if name in self._logs:
            self._logs[name].add(stamp_ns, message.name, message.position, message.velocity)
            return ()
        answer = self._topics.receive(name, stamp_ns, message.name, message.position,
                                      message.velocity, message.effort)
        messages = tuple(answer.messages)
        if name == names.FLYWHEEL_STATES and not answer.rejection and (
                not result.ticks_ns or result.ticks_ns[-1] != stamp_ns):
            self._log_tick(stamp_ns, messages)
        return messages

    def _log_tick(self, stamp_ns: int, messages: tuple[OutputMessage, ...]) -> None:
        result = self._result
        result.ticks_ns.append(stamp_ns)
        logs = {names.ESTIMATE_LINK_STATES: result.replayed.states,
                names.ESTIMATE_INNOVATION: result.replayed.innovations}
        for message in messages:
            if message.topic in logs:
                logs[message.topic].add(
                    stamp_ns, message.names, *(values.tolist() for values in message.values[:2]))
            result.waiting += message.topic == names.ESTIMATE_WAITING
        self._fault_ticks.update(f'{sensor}: {fault}' for sensor, fault in
                                 self._topics.estimator.sensor_faults().items())

    def _read_diagnostics(self, message: Any) -> None:
        """Read the counters of the recorded estimator; the last message has the totals."""
        for status in message.status:
            if status.name != f'{self._result.namespace}/{NODE}'.lstrip('/'):
                continue
            values = {item.key: item.value for item in status.values}
            recorded = self._result.recorded
            faults = recorded.counters.faults if recorded.counters else {}
            faults.update(dict.fromkeys(
                filter(None, values.get('sensor_faults', '').split(', '))))
            rejected, gated = (
                {key[len(prefix):]: _as_count(value) for key, value in values.items()
                 if key.startswith(prefix)} for prefix in ('rejected_', 'gated_'))
            recorded.counters = EstimatorCounters(
                _as_count(values.get('starts', '')), rejected, gated, faults)

    def _finish(self) -> None:
        """Take the counters of the replayed estimator."""
        estimator = self._topics.estimator
        periods = np.diff(np.array(self._result.ticks_ns, dtype=np.int64))
        period_s = float(np.median(periods)) * 1e-9 if len(periods) else 0.0
        self._result.replayed.counters = EstimatorCounters(
            estimator.starts, dict(estimator.rejected), dict(estimator.gated),
            {fault: count * period_s for fault, count in self._fault_ticks.items()})


def _as_count(text: str) -> int:
    return int(text) if text.isdecimal() else 0


class _EstimateWriter:
    """Writes messages of the estimator into a bag, with the QoS profiles of the recorded ones."""

    def __init__(self, writer: Any, namespace: str, recorded: Sequence[Connection]) -> None:
        from rosbags.typesys import get_typestore, Stores

        self._writer = writer
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._namespace = namespace
        self._connections: dict[str, Any] = {}
        self._recorded: dict[str, Any] = {
            connection.topic: connection.ext for connection in recorded}
        for name in (*OUTPUTS, names.ESTIMATE_WAITING):
            if name == names.ESTIMATE_WAITING or not OUTPUTS[name].optional:
                self._add_connection(name)

    def _add_connection(self, name: str) -> None:
        topic, recorded = f'{self._namespace}/{name}', self._recorded
        self._connections[name] = self._writer.add_connection(
            topic, JOINT_STATE if name in OUTPUTS else HEADER, typestore=self._store,
            offered_qos_profiles=recorded[topic].offered_qos_profiles if topic in recorded else ())

    def __call__(self, message: OutputMessage, logged_ns: int) -> None:
        """Write one message."""
        if message.topic not in self._connections:
            self._add_connection(message.topic)
        types, output = self._store.types, OUTPUTS.get(message.topic)
        sec, nanosec = divmod(message.stamp_ns, 1_000_000_000)
        stamp = types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
        content = types[HEADER](stamp=stamp, frame_id=output.frame if output else '')
        if output:
            arrays = {name: np.empty(0) for name in ('position', 'velocity', 'effort')}
            # A field of a structured array is strided, which rosbags does not serialize.
            arrays.update(zip(output.fields, map(np.ascontiguousarray, message.values)))
            content = types[JOINT_STATE](header=content, name=list(message.names), **arrays)
        self._writer.write(self._connections[message.topic], logged_ns,
                           self._store.serialize_cdr(content, JOINT_STATE if output else HEADER))
