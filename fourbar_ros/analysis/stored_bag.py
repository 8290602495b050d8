# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The messages of a bag as they are stored: bytes in the order of their log times."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TYPE_CHECKING

from fourbar_ros.analysis.bags import BagError, check_directory

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

FILE_SUFFIXES = ('.mcap', '.db3')


class StoredBag:
    """
    An open bag.

    :ivar path: the directory, or its only file.
    :ivar connections: what rosbags tells of each topic, of type and quality of service.
    :ivar topics: type by absolute name.
    """

    def __init__(self, path: Path, reader: Any) -> None:
        from rosbags.typesys import get_typestore, Stores

        self.path = path
        self.connections: list[Connection] = list(reader.connections)
        self.topics: Mapping[str, str] = {
            connection.topic: connection.msgtype for connection in self.connections}
        self._reader = reader
        self._deserialize = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr

    def messages(self, connections: Collection[Connection] | None = None
                 ) -> Iterator[tuple[Connection, int, bytes]]:
        """
        Go through the messages of all topics, or of some.

        :returns: topic, log time [ns] and content of each.
        :raises BagError: the file is damaged, or there are fewer than there should be.
        """
        chosen = self.connections if connections is None else connections
        if not chosen:
            return
        stream = iter(self._reader.messages(chosen))
        found = 0
        while True:
            try:
                entry = next(stream, None)
            except Exception as error:  # a damaged file can break any layer: SQL, MCAP, zstd
                raise self._damaged(error) from error
            if entry is None:
                break
            found += 1
            yield entry
        expected = sum(connection.msgcount for connection in chosen)
        if found < expected:
            raise BagError(f'{self.path} is cut: {found} of {expected} messages are left')

    def content(self, connection: Connection, data: bytes) -> Any:
        """
        Read a message of a standard type.

        :raises BagError: the bytes are no such message.
        """
        try:
            return self._deserialize(data, connection.msgtype)
        except Exception as error:  # whatever wrong bytes lead to
            raise self._damaged(error, f', a message on {connection.topic}') from error

    def _damaged(self, error: Exception, place: str = '') -> BagError:
        return BagError(f'{self.path} is cut or damaged{place}: {_one_line(error)}')


@contextmanager
def open_bag(path: str | Path) -> Iterator[StoredBag]:
    """
    Open a rosbag2 directory, or the single MCAP or SQLite file of one.

    :raises BagError: missing, no bag, not closed by its recorder, cut, damaged, or empty.
    """
    from rosbags.rosbag2 import Reader

    path = Path(path)
    _check(path)
    try:
        reader = Reader(path)
        reader.open()
    except Exception as error:  # a damaged file can break any layer: YAML, SQL, MCAP, zstd
        raise BagError(f'{path} cannot be read, it is cut, damaged or of a kind that is unknown '
                       f'here: {_one_line(error)}') from error
    try:
        if not reader.message_count:
            raise BagError(f'{path} holds no messages')
        yield StoredBag(path, reader)
    finally:
        reader.close()


def _check(path: Path) -> None:
    if not path.is_file():
        check_directory(path)
    elif path.suffix not in FILE_SUFFIXES:
        raise BagError(f'{path} is not a bag: name a rosbag2 directory, or a file that ends in '
                       f'{" or ".join(FILE_SUFFIXES)}')


def _one_line(error: Exception) -> str:
    return ' '.join(str(error).split()) or type(error).__name__


def copier(writer: Any, warn: Callable[[str], None]) -> Callable[[Connection], Connection]:
    """
    Make a function that declares a topic of a bag in another one, once.

    Definition and hash of its type are those of the bag. Where that has none (SQLite before ROS 2
    Iron), they are those of Jazzy; a type that is unknown there, too, goes without.

    :param writer: an open rosbags writer.
    :param warn: is told of a type that goes without.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_typestore, Stores

    store = get_typestore(Stores.ROS2_JAZZY)
    made: dict[tuple[str, str], Connection] = {}

    def copy(connection: Connection) -> Connection:
        key = connection.topic, connection.msgtype
        if key in made:
            return made[key]
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
            # What recorders write of a type whose hash they do not know; rosbags insists on one.
            new = writer.connections[-1] = new._replace(digest='')
        made[key] = new
        return new
    return copy
