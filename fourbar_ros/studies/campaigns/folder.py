# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The folder of a campaign: rows of finished runs in Parquet, whatever happens to the process.

`campaign.json` says whose rows these are. `parts` holds rows as they come, in files that are whole
or not there; two of them may hold the same run if the process died between putting parts together
and removing them, and then the rows are the same. `runs.parquet` has all rows in the order of the
runs, without the time that they took, which alone is not the same every time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import contextlib
import fcntl
import io
import json
import os
from pathlib import Path
from typing import Any

from fourbar_ros.studies.campaigns.file import Campaign
from fourbar_ros.studies.campaigns.processes import CampaignError
from fourbar_ros.studies.campaigns.run import METRICS, Row, WALL
import numpy as np
import pyarrow as pa
from pyarrow import parquet

IDENTITY, PARTS, RUNS = 'campaign.json', 'parts', 'runs.parquet'
# More files than this are put together.
MOST_PARTS = 200
_UNFINISHED = '.unfinished'
_TYPES = {float: pa.float64(), bool: pa.bool_(), str: pa.string()}


class CampaignFolder:
    """
    The rows of a campaign, on disk. Use it with `with`: meanwhile it belongs to this process.

    :param path: the folder, made if it is missing.
    :param campaign: whose runs these are.
    :raises CampaignError: another process has it, it belongs to another campaign, or it cannot
        be read or written.
    """

    def __init__(self, path: Path, campaign: Campaign) -> None:
        self.path = path
        self.campaign = campaign
        self.schema = schema_of(campaign)
        self._parts: list[Path] = []
        self._lock = -1

    def __enter__(self) -> CampaignFolder:
        """Take the folder, and see what is in it."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            # Of the folder itself: so no file of it is left, and the kernel lets go of it when
            # the process dies.
            self._lock = os.open(self.path, os.O_RDONLY)
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise CampaignError(f'{self.path} is in use by another campaign that runs: '
                                    'choose another --output or wait for it') from None
            (self.path / PARTS).mkdir(exist_ok=True)
            for left in (*self.path.glob(f'.*{_UNFINISHED}'),
                         *(self.path / PARTS).glob(f'.*{_UNFINISHED}')):
                left.unlink()
            self._parts = sorted((self.path / PARTS).glob('*.parquet'))
            self._claim()
        except OSError as error:
            self._let_go()
            raise CampaignError(
                f'cannot use {self.path}: {error.strerror or error}') from None
        except CampaignError:
            self._let_go()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Let go of it, and leave nothing if it holds no row."""
        if self._empty():
            with contextlib.suppress(OSError):
                (self.path / PARTS).rmdir()
                (self.path / IDENTITY).unlink()
        self._let_go()

    def rows(self) -> pa.Table:
        """
        Return all rows so far in the order of the runs, wall time included.

        :raises CampaignError: a file is damaged.
        """
        tables = [self.schema.empty_table(), *map(self._read, self._parts)]
        table = pa.concat_tables(tables)
        _, first = np.unique(table['run'].to_numpy(), return_index=True)
        return table.take(pa.array(first)).combine_chunks()

    def add(self, rows: Sequence[Row]) -> None:
        """
        Keep the rows of finished runs.

        :raises CampaignError: they cannot be written; nothing of them is.
        """
        self._keep(pa.Table.from_pylist(list(rows), schema=self.schema))
        if len(self._parts) > MOST_PARTS:
            self._put_together()

    def finish(self) -> pa.Table:
        """
        Write all rows into `runs.parquet`, the same bytes for the same rows.

        :returns: what is in it.
        :raises CampaignError: it cannot be written.
        """
        self._put_together()
        table = self.rows().drop_columns([WALL])
        _write(self.path / RUNS, _bytes(table))
        return table

    def _empty(self) -> bool:
        return not self._parts and not (self.path / RUNS).exists()

    def _claim(self) -> None:
        """Say whose it is, or see that it is ours."""
        path = self.path / IDENTITY
        ours = self.campaign.identity
        if self._empty():
            # Of a campaign that came to nothing, perhaps.
            text = json.dumps({'hash': self.campaign.hash, **ours}, indent=2)
            _write(path, text.encode() + b'\n')
            return
        if not path.exists():
            raise CampaignError(f'{self.path} holds runs but no {IDENTITY}: choose another '
                                '--output')
        try:
            theirs = json.loads(path.read_text())
            if not isinstance(theirs, dict):
                raise ValueError
        except ValueError:
            raise CampaignError(f'{path} is damaged: choose another --output') from None
        if theirs.pop('hash', None) != self.campaign.hash:
            raise CampaignError(
                f'{self.path} holds runs of another campaign ({_differs(theirs, ours)}): choose '
                'another --output, or remove it')

    def _put_together(self) -> None:
        """Make one part of all."""
        if len(self._parts) > 1:
            before, table = self._parts, self.rows()
            self._parts = []
            self._keep(table)
            for part in before:
                # One that is left holds nothing new.
                with contextlib.suppress(OSError):
                    part.unlink()

    def _keep(self, table: pa.Table) -> None:
        """Write a part. One with more runs has another name than those it is made of."""
        path = self.path / PARTS / f'from_{table["run"][0].as_py():07d}_{len(table)}.parquet'
        _write(path, _bytes(table))
        self._parts.append(path)

    def _read(self, path: Path) -> pa.Table:
        try:
            return parquet.read_table(path, schema=self.schema, partitioning=None)
        except (pa.ArrowException, OSError) as error:
            raise CampaignError(f'{path} is damaged ({" ".join(str(error).split())[:80]}): '
                                'remove it, and its runs are made again') from None

    def _let_go(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def schema_of(campaign: Campaign) -> pa.Schema:
    """Return the columns of a campaign."""
    return pa.schema([
        ('run', pa.int64()), ('seed', pa.int64()),
        *((name, _TYPES[kind]) for name, kind in campaign.columns.items()),
        *((name, pa.float64()) for name in METRICS),
        ('armed_at_end', pa.bool_()), ('failure', pa.string()), (WALL, pa.float64())])


def _bytes(table: pa.Table) -> bytes:
    buffer = io.BytesIO()
    parquet.write_table(table, buffer, compression='zstd')
    return buffer.getvalue()


def _write(path: Path, content: bytes) -> None:
    """
    Write a file that is whole or not there.

    :raises CampaignError: it cannot be written.
    """
    unfinished = path.with_name(f'.{path.name}{_UNFINISHED}')
    try:
        with open(unfinished, 'wb') as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            unfinished.unlink()
        raise CampaignError(f'cannot write {path}: {error.strerror or error}') from None


def _differs(theirs: dict[str, Any], ours: dict[str, Any]) -> str:
    """Say where two campaigns differ, the first few places."""
    places = list(_places('', theirs, ours))
    return ', '.join(places[:3]) + (' and more' if len(places) > 3 else '')


def _places(name: str, theirs: Any, ours: Any) -> Iterable[str]:
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in dict.fromkeys([*theirs, *ours]):
            yield from _places(f'{name}.{key}'.lstrip('.'), theirs.get(key), ours.get(key))
    elif theirs != ours:
        yield f'{name} differs'
