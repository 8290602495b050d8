# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The parameter tables of all nodes, and the files made from them.

`python -m fourbar_ros.ros.tables` writes config/nodes.yaml to standard output, with
`--markdown` the tables of docs/topics.md, and with `--prototype` config/nodes_prototype.yaml.
"""

import sys

from fourbar_ros.control.parameters import PARAMETERS as CONTROLLER_PARAMETERS
from fourbar_ros.estimation.parameters import PARAMETERS as ESTIMATOR_PARAMETERS
from fourbar_ros.loop import load_scenario
from fourbar_ros.ros import hardware, plant, prototype_emulator

TABLES = {
    'plant': plant.PARAMETERS,
    'hardware': hardware.PARAMETERS,
    'prototype_emulator': prototype_emulator.PARAMETERS,
    'estimator': ESTIMATOR_PARAMETERS,
    'controller': CONTROLLER_PARAMETERS,
}


def yaml_text():
    """Write a parameters file that holds in any namespace."""
    lines = ['# Parameters of all nodes with their defaults, for --ros-args --params-file FILE.',
             '# The keys hold in any namespace.']
    for node, table in TABLES.items():
        lines += ['', f'/**/{node}:', '  ros__parameters:']
        for row in table:
            unit = f' [{row.unit}]' if row.unit else ''
            lines.append(f'    {row.name}: {_scalar(row.default)}  # {row.meaning}{unit}')
    return '\n'.join(lines) + '\n'


def prototype_text():
    """Write a parameters file that makes all nodes run as the prototype's scenario has it."""
    scenario = load_scenario('prototype')
    lines = ['# Parameters of all nodes for the bench-scale linkage that are not the defaults.',
             '# As in scenario_prototype.yaml; the keys hold in any namespace.']
    for node, values in scenario.parameters().items():
        lines += ['', f'/**/{node}:', '  ros__parameters:']
        for row in TABLES[node]:
            if row.name.startswith('initial.'):
                continue
            if values.get(row.name, row.default) != row.default:
                unit = f' [{row.unit}]' if row.unit else ''
                scalar = _scalar(values[row.name])
                lines.append(f'    {row.name}: {scalar}  # {row.meaning}{unit}')
    return '\n'.join(lines) + '\n'


def markdown_text():
    """Write one table per node."""
    lines = []
    for node, table in TABLES.items():
        lines += [f'#### `{node}`', '',
                  '| parameter | default | unit | allowed | at run time | meaning |',
                  '|---|---|---|---|---|---|']
        for row in table:
            allowed = ''
            if row.choices is not None:
                allowed = ', '.join(f'`{choice}`' for choice in row.choices)
            elif row.limits is not None:
                allowed = f'{row.limits[0]:g} to {row.limits[1]:g}'
            default = '' if row.default == '' else f'`{row.default}`'
            lines.append(f'| `{row.name}` | {default} | {row.unit} | {allowed} | '
                         f'{"yes" if row.live else "no"} | {row.meaning} |')
        lines.append('')
    return '\n'.join(lines)


def _scalar(value):
    if isinstance(value, str):
        return f"'{value}'"
    if isinstance(value, bool):
        return str(value).lower()
    # YAML 1.1 takes 1e-07 for a string: a float needs its point.
    text = repr(value)
    if 'e' in text and '.' not in text:
        text = text.replace('e', '.0e')
    return text


if __name__ == '__main__':
    text = {'--markdown': markdown_text, '--prototype': prototype_text}
    sys.stdout.write(text.get(sys.argv[-1], yaml_text)())
