# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The parameters of all nodes, and the files that are generated from their declarations.

`python -m fourbar_ros.ros.parameters` writes config/nodes.yaml to standard output, with
`--prototype` config/nodes_prototype.yaml, and with `--markdown` the tables of docs/topics.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
import sys
from typing import Any

from fourbar_ros.common.settings import Setting
from fourbar_ros.control.settings import PARAMETERS as CONTROLLER_PARAMETERS
from fourbar_ros.estimation.estimator_settings import PARAMETERS as ESTIMATOR_PARAMETERS
from fourbar_ros.loop import load_scenario
from fourbar_ros.ros import hardware, plant, prototype_emulator
from fourbar_ros.ros.base_node import COMMON_PARAMETERS

TABLES: dict[str, Sequence[Setting]] = {
    node: (*settings, *COMMON_PARAMETERS) for node, settings in {
        'plant': plant.PARAMETERS,
        'hardware': hardware.PARAMETERS,
        'prototype_emulator': prototype_emulator.PARAMETERS,
        'estimator': ESTIMATOR_PARAMETERS,
        'controller': CONTROLLER_PARAMETERS,
    }.items()}


def yaml_text() -> str:
    """Return a parameters file with all defaults, valid in any namespace."""
    lines = ['# Parameters of all nodes with their defaults, for --ros-args --params-file FILE.',
             '# The keys hold in any namespace.']
    for node, table in TABLES.items():
        lines += ['', f'/**/{node}:', '  ros__parameters:']
        lines += [_yaml_line(row, row.default) for row in table]
    return '\n'.join(lines) + '\n'


def prototype_text() -> str:
    """Return a parameters file with which the nodes run the scenario of the prototype."""
    lines = ['# Parameters of all nodes for the bench-scale linkage that are not the defaults.',
             '# As in scenario_prototype.yaml; the keys hold in any namespace.']
    for node, values in load_scenario('prototype').parameters().items():
        lines += ['', f'/**/{node}:', '  ros__parameters:']
        lines += [_yaml_line(row, values[row.name]) for row in TABLES[node]
                  if not row.name.startswith('initial.')
                  and values.get(row.name, row.default) != row.default]
    return '\n'.join(lines) + '\n'


def markdown_text() -> str:
    """Return one table for each set of nodes with equal parameters, no parameter twice."""
    nodes_of: dict[Setting, list[str]] = {}
    for node, table in TABLES.items():
        for row in table:
            nodes_of.setdefault(row, []).append(node)
    tables: dict[tuple[str, ...], list[Setting]] = {}
    for row, nodes in nodes_of.items():
        tables.setdefault(tuple(nodes), []).append(row)
    lines = []
    for names, rows in tables.items():
        lines += [f'#### {", ".join(f"`{name}`" for name in names)}', '',
                  '| parameter | default | unit | allowed | at run time | meaning |',
                  '|---|---|---|---|---|---|']
        # Parameters that differ by their name only share a line.
        for _, same in groupby(rows, lambda row: replace(row, name='')):
            lines.append(_markdown_line(list(same)))
        lines.append('')
    return '\n'.join(lines)


def _markdown_line(rows: Sequence[Setting]) -> str:
    row = rows[0]
    allowed = ''
    if row.choices is not None:
        allowed = ', '.join(f'`{choice}`' for choice in row.choices)
    elif row.limits is not None:
        # Whole numbers in full, but the largest seed, 2^63 - 1.
        low, high = (f'{limit:.10g}' for limit in row.limits)
        allowed = f'{low} to {high}'
    default = '' if row.default == '' else f'`{row.default}`'
    return (f'| {", ".join(f"`{each.name}`" for each in rows)} | {default} | {row.unit} | '
            f'{allowed} | {"yes" if row.live else "no"} | {row.meaning} |')


def _yaml_line(row: Setting, value: Any) -> str:
    unit = f' [{row.unit}]' if row.unit else ''
    return f'    {row.name}: {_scalar(value)}  # {row.meaning}{unit}'


def _scalar(value: Any) -> str:
    if isinstance(value, str):
        return f"'{value}'"
    if isinstance(value, bool):
        return str(value).lower()
    # YAML 1.1 reads 1e-07 as text: a float needs its point.
    text = repr(value)
    if 'e' in text and '.' not in text:
        text = text.replace('e', '.0e')
    return text


if __name__ == '__main__':
    text = {'--markdown': markdown_text, '--prototype': prototype_text}
    sys.stdout.write(text.get(sys.argv[-1], yaml_text)())
