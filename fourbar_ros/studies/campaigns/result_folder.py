# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The folder of a campaign: rows of finished runs in Parquet, safe against a crash at any time.

`campaign.json` holds the identity of the campaign. `parts` holds the rows in the order in which
runs finish, in files that are written atomically. Two of them may hold the same run, with equal
rows, if the process died between merging parts and removing the merged ones. `runs.parquet` has
all rows in the order of the runs, without the duration of the computation.
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

from fourbar_ros.common.output_files import write_files
from fourbar_ros.studies.campaigns import CampaignError
from fourbar_ros.studies.campaigns.campaign import Campaign
from fourbar_ros.studies.campaigns.campaign_metrics import METRICS
from fourbar_ros.studies.campaigns.campaign_run import Row, WALL
import numpy as np
import pyarrow as pa
from pyarrow import parquet

IDENTITY, PARTS, RUNS = 'campaign.json', 'parts', 'runs.parquet'
# Number of part files above which they are merged.
MOST_PARTS = 200
_TYPES = {float: pa.float64(), bool: pa.bool_(), str: pa.string()}


class ResultFolder:
    """
    The rows of a campaign on disk; a context manager that locks the folder for this process.

    :param path: the folder, made if it is missing.
    :param campaign: whose runs it holds.
    :raises CampaignError: another process uses it, it belongs to another campaign, or it cannot
        be read or written.
    """

    def __init__(self, path: Path, campaign: Campaign) -> None:
        self.path = path
        self.campaign = campaign
        self.schema = schema_of(campaign)
        self._parts: list[Path] = []
        self._lock = -1

    def __enter__(self) -> ResultFolder:
        """Lock the folder and read which parts it holds."""
        with contextlib.ExitStack() as on_error:
            on_error.callback(self._unlock)
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                # A lock of the folder itself leaves no file, and ends with the process.
                self._lock = os.open(self.path, os.O_RDONLY)
                try:
                    fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise CampaignError(f'{self.path} is in use by another campaign: choose '
                                        'another --output or wait', path=self.path) from None
                parts = self.path / PARTS
                parts.mkdir(exist_ok=True)
                for unfinished in (*self.path.glob(f'.{IDENTITY}.*'),
                                   *self.path.glob(f'.{RUNS}.*'), *parts.glob('.*')):
                    unfinished.unlink()
                self._parts = sorted(parts.glob('*.parquet'))
            except OSError as error:
                raise CampaignError(f'cannot use {self.path}: {error.strerror or error}',
                                    path=self.path, errno=error.errno) from None
            self._claim()
            on_error.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Unlock the folder, and remove what was made in it if it holds no row."""
        if self._empty():
            with contextlib.suppress(OSError):
                (self.path / PARTS).rmdir()
                (self.path / IDENTITY).unlink()
        self._unlock()

    def rows(self) -> pa.Table:
        """
        Return all rows so far in the order of the runs, with the duration of the computation.

        :raises CampaignError: a file is damaged.
        """
        table = pa.concat_tables([self.schema.empty_table(), *map(self._read, self._parts)])
        _, first = np.unique(table['run'].to_numpy(), return_index=True)
        return table.take(pa.array(first)).combine_chunks()

    def add(self, rows: Sequence[Row]) -> None:
        """
        Store the rows of finished runs.

        :raises OutputError: they cannot be written; none of them is.
        """
        self._store(pa.Table.from_pylist(list(rows), schema=self.schema))
        if len(self._parts) > MOST_PARTS:
            self._merge()

    def finish(self) -> pa.Table:
        """
        Write all rows into `runs.parquet`, the same bytes for the same rows.

        :returns: its content.
        :raises OutputError: it cannot be written.
        """
        self._merge()
        table = self.rows().drop_columns([WALL])
        _write(self.path / RUNS, table)
        return table

    def _empty(self) -> bool:
        return not self._parts and not (self.path / RUNS).exists()

    def _claim(self) -> None:
        """Write the identity of the campaign, or check that it is the one in the folder."""
        path = self.path / IDENTITY
        ours = self.campaign.identity
        if self._empty():
            # An identity without rows may be of an earlier campaign that finished no run.
            text = json.dumps({'hash': self.campaign.digest, **ours}, indent=2)
            write_files({path: f'{text}\n'})
            return
        if not path.exists():
            raise CampaignError(f'{self.path} holds runs but no {IDENTITY}: choose another '
                                '--output', path=path)
        try:
            theirs = json.loads(path.read_text())
            if not isinstance(theirs, dict):
                raise ValueError
        except ValueError:
            raise CampaignError(f'{path} is damaged: choose another --output',
                                path=path) from None
        if theirs.pop('hash', None) != self.campaign.digest:
            different = list(_different_keys('', theirs, ours))
            raise CampaignError(
                f'{self.path} holds runs of another campaign (different: '
                f'{", ".join(different[:3])}{" and more" if len(different) > 3 else ""}): choose '
                'another --output, or remove it', path=self.path, different=different)

    def _merge(self) -> None:
        """Merge all parts into one."""
        if len(self._parts) > 1:
            merged, table = self._parts, self.rows()
            self._parts = []
            self._store(table)
            for part in merged:
                # The rows of one that cannot be removed are counted once.
                with contextlib.suppress(OSError):
                    part.unlink()

    def _store(self, table: pa.Table) -> None:
        """Write a part; its name differs from those of the parts it merges."""
        path = self.path / PARTS / f'from_{table["run"][0].as_py():07d}_{len(table)}.parquet'
        _write(path, table)
        self._parts.append(path)

    def _read(self, path: Path) -> pa.Table:
        try:
            return parquet.read_table(path, schema=self.schema, partitioning=None)
        except (pa.ArrowException, OSError) as error:
            raise CampaignError(
                f'{path} is damaged ({" ".join(str(error).split())[:80]}): remove it, and its '
                'runs are repeated', path=path) from None

    def _unlock(self) -> None:
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


def _write(path: Path, table: pa.Table) -> None:
    buffer = io.BytesIO()
    parquet.write_table(table, buffer, compression='zstd')
    write_files({path: buffer.getvalue()})


def _different_keys(name: str, theirs: Any, ours: Any) -> Iterable[str]:
    """Return the names of the values in which two identities differ."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in dict.fromkeys([*theirs, *ours]):
            yield from _different_keys(f'{name}.{key}'.lstrip('.'), theirs.get(key),
                                       ours.get(key))
    elif theirs != ours:
        yield name
