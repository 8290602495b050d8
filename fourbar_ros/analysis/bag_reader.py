# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Read the stored messages of a rosbag2 bag: serialized bytes in the order of their log times."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TYPE_CHECKING

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.progress import no_progress, Progress

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

JOINT_STATE = 'sensor_msgs/msg/JointState'
DIAGNOSTIC_STATUS = 'diagnostic_msgs/msg/DiagnosticStatus'
# rosbag2 storage identifier by file suffix.
STORAGES = {'.mcap': 'mcap', '.db3': 'sqlite3'}


class BagError(FourbarError):
    """
    A bag that cannot be read, or that lacks requested data.

    Its `values` hold `path` and `reason`, and `topic` where one is concerned. Reasons: `missing`,
    `not_a_bag`, `no_metadata`, `damaged`, `no_topic`, `no_message`, `type`, `ambiguous`,
    `no_data`.
    """


def bag_error(path: Path, reason: str, message: str, **values: Any) -> BagError:
    """Return an error about a bag: the path, then the message."""
    return BagError(f'{path}{message}', path=str(path), reason=reason, **values)


def absolute_name(*parts: str) -> str:
    """Return the absolute topic name or namespace of name parts, '/' for the root."""
    return '/' + '/'.join(filter(None, '/'.join(parts).split('/')))


class BagReader:
    """
    An open bag.

    :ivar path: the directory, or its only storage file.
    :ivar connections: topic, type, QoS profiles and number of messages of each connection.
    :ivar topics: message type by absolute topic name.
    :ivar info: the underlying reader of rosbags, for times and counts.
    """

    def __init__(self, path: Path, reader: Any) -> None:
        from rosbags.typesys import get_typestore, Stores

        self.path = path
        self.info = reader
        self.connections: list[Connection] = list(reader.connections)
        self.topics: dict[str, str] = {
            connection.topic: connection.msgtype for connection in self.connections}
        self._deserialize = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr

    def count(self, topic: str) -> int:
        """Return the number of messages of a topic."""
        return sum(connection.msgcount for connection in self.connections
                   if connection.topic == topic)

    def messages(self, connections: Collection[Connection] | None = None,
                 progress: Progress = no_progress) -> Iterator[tuple[Connection, int, bytes]]:
        """
        Iterate over the messages of some connections, by default of all.

        :returns: connection, log time [ns] and serialized message.
        :raises BagError: the file is damaged, or holds fewer messages than its metadata state.
        """
        selected = self.connections if connections is None else connections
        if not selected:
            return
        expected = sum(connection.msgcount for connection in selected)
        count = 0
        try:
            for entry in progress(self.info.messages(selected), expected):
                count += 1
                yield entry
        except Exception as error:  # a damaged file can break any layer: SQL, MCAP, zstd
            raise self._damaged(error) from error
        if count < expected:
            raise bag_error(self.path, 'damaged',
                            f' is truncated: it holds {count} of {expected} messages',
                            value=count, limit=expected)

    def deserialize(self, connection: Connection, data: bytes) -> Any:
        """
        Deserialize a message of a standard type.

        :raises BagError: the bytes are no message of that type.
        """
        try:
            return self._deserialize(data, connection.msgtype)
        except Exception as error:  # arbitrary bytes raise arbitrary errors
            raise self._damaged(error, f', message on {connection.topic}') from error

    def _damaged(self, error: Exception, place: str = '') -> BagError:
        return bag_error(self.path, 'damaged',
                         f' is truncated or damaged{place}: {_one_line(error)}')


@contextmanager
def open_bag(path: Path) -> Iterator[BagReader]:
    """
    Open a rosbag2 directory, or the single MCAP or SQLite file of one.

    :raises BagError: missing, no bag, not closed by its recorder, truncated or damaged.
    """
    from rosbags.rosbag2 import Reader

    if not path.is_file():
        check_directory(path)
    elif path.suffix not in STORAGES:
        raise bag_error(path, 'not_a_bag', ' is not a bag: name a rosbag2 directory, or a file '
                        f'that ends in {" or ".join(STORAGES)}')
    try:
        reader = Reader(path)
        reader.open()
    except Exception as error:  # a damaged file can break any layer: YAML, SQL, MCAP, zstd
        raise bag_error(path, 'damaged', ' cannot be read, it is truncated, damaged or of an '
                        f'unknown format: {_one_line(error)}') from error
    try:
        yield BagReader(path, reader)
    finally:
        reader.close()


def check_directory(path: Path) -> None:
    """
    Check that a path is a rosbag2 directory.

    :raises BagError: it is missing, a file, or has no metadata.
    """
    if not path.exists():
        raise bag_error(path, 'missing', ': no such directory')
    if not path.is_dir():
        raise bag_error(path, 'not_a_bag',
                        ' is a file: name the rosbag2 directory that contains it')
    if (path / 'metadata.yaml').is_file():
        return
    for suffix, storage in STORAGES.items():
        if any(path.glob(f'*{suffix}')):
            repair = f'ros2 bag reindex -s {storage} {path}'
            raise bag_error(path, 'no_metadata', ' has no metadata.yaml, its recorder was killed: '
                            f'repair it with `{repair}`', repair=repair)
    raise bag_error(path, 'not_a_bag', ' is not a rosbag2 directory: it has no metadata.yaml')


def _one_line(error: Exception) -> str:
    return ' '.join(str(error).split()) or type(error).__name__


def connection_copier(writer: Any, warn: Callable[[str], None]
                      ) -> Callable[[Connection], Connection]:
    """
    Return a function that adds a connection of a bag to another bag, once.

    Definition and hash of the message type are those of the bag. Where the bag has none (SQLite
    before ROS 2 Iron), those of Jazzy are used; a type that Jazzy does not have is copied without.

    :param writer: an open rosbags writer.
    :param warn: called with a message for each type that is copied without its definition.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_typestore, Stores

    store = get_typestore(Stores.ROS2_JAZZY)
    copies: dict[tuple[str, str], Connection] = {}

    def copy(connection: Connection) -> Connection:
        key = connection.topic, connection.msgtype
        if key in copies:
            return copies[key]
        definition, digest = connection.msgdef.data, connection.digest
        if connection.msgdef.format == MessageDefinitionFormat.NONE:
            definition = ''
            if connection.msgtype in store.types:
                definition = store.generate_msgdef(connection.msgtype, ros_version=2)[0]
                digest = store.hash_rihs01(connection.msgtype)
            else:
                warn(f'{connection.topic} is copied without the definition of its type '
                     f'{connection.msgtype}: the bag has none')
        ext: Any = connection.ext
        new: Connection = writer.add_connection(
            connection.topic, connection.msgtype, msgdef=definition, rihs01=digest or 'unknown',
            serialization_format=ext.serialization_format,
            offered_qos_profiles=ext.offered_qos_profiles)
        if not digest:
            # Recorders store '' for an unknown hash; rosbags requires a value and gets one above.
            new = writer.connections[-1] = new._replace(digest='')
        copies[key] = new
        return new
    return copy
