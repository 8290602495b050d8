# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Documents agree with the code: generated tables, commands, limits and links."""

from collections.abc import Mapping
from dataclasses import fields, MISSING
from math import inf, nextafter
from pathlib import Path
import re
from typing import Any

from fourbar_ros.cli.main import COMMANDS
from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.hardware.safety_table import CONDITIONS, load_safety
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, Mechanism
from fourbar_ros.plant.energy_budget import EnergyBudget
from fourbar_ros.plant.fault_schedule import parse_schedule, read_schedule
from fourbar_ros.plant.faults import FaultKind, SENSOR_FAULTS, WHEEL_FAULTS
from fourbar_ros.plant.table import SECTIONS
from fourbar_ros.ros.parameters import markdown_text, prototype_text, yaml_text
import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / 'README.md', *(ROOT / 'docs').rglob('*.md')])


def test_parameter_tables_are_those_of_the_nodes() -> None:
    """Regenerate with `python -m fourbar_ros.ros.parameters --markdown`."""
    assert markdown_text() in (ROOT / 'docs' / 'topics.md').read_text()


def test_parameters_file_is_that_of_the_nodes() -> None:
    """Regenerate with `python -m fourbar_ros.ros.parameters > config/nodes.yaml`."""
    assert (ROOT / 'config' / 'nodes.yaml').read_text() == yaml_text()


def test_parameters_file_of_the_prototype_is_that_of_its_scenario() -> None:
    """Regenerate with `python -m fourbar_ros.ros.parameters --prototype`, and so on."""
    assert (ROOT / 'config' / 'nodes_prototype.yaml').read_text() == prototype_text()


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_exist(page: Path) -> None:
    """Follow every relative link and picture."""
    targets = re.findall(r'\]\(([^)#\s]+)\)', page.read_text())
    missing = [target for target in targets
               if not target.startswith('http') and not (page.parent / target).exists()]
    assert missing == []


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_exist(page: Path) -> None:
    """Every `fourbar NAME` in a code block is a command."""
    blocks = re.findall(r'```\n(.*?)```', page.read_text(), re.DOTALL)
    names = {name for block in blocks
             for name in re.findall(r'^(?:ros2 run fourbar_ros|fourbar) ([a-z]\w*)', block,
                                    re.MULTILINE)}
    assert names <= {*COMMANDS, 'fourbar'}


Rows = dict[str, list[str]]


def table_under(heading: str) -> Rows:
    """Return the first table below a heading of table.md as cells by key."""
    text = (ROOT / 'docs' / 'table.md').read_text()
    below = text.split(f'\n{heading}\n', 1)[1]
    block = re.search(r'(?:^\|.*\|\n)+', below, re.MULTILINE)
    assert block is not None
    rows = [[cell.strip() for cell in line.strip('|').split('|')]
            for line in block.group().splitlines()[2:]]
    return {row[0].strip('`'): row[1:] for row in rows}


def number(cell: str) -> Any:
    """Read a cell: a number, or anything else as text."""
    try:
        return float(cell)
    except ValueError:
        return cell.strip('`')


@pytest.mark.parametrize('section', list(SECTIONS))
def test_keys_of_a_table_file_are_documented(section: str) -> None:
    """The page has exactly the keys, with defaults and the values of the presets."""
    documented = table_under(f'### `{section}`')
    keys = {item.name: item.default for item in fields(SECTIONS[section])}
    assert list(documented) == list(keys)
    presets = [load_yaml(config_file('table', name))[section] if section in load_yaml(
        config_file('table', name)) else {} for name in ('ideal', 'prototype')]
    for key, default in keys.items():
        values = ['' if value is MISSING else str(value).lower() if isinstance(value, bool)
                  else value for value in (default, *(preset.get(key, '') for preset in presets))]
        assert [number(cell) for cell in documented[key][2:5]] == values, key


@pytest.mark.parametrize('section', list(SECTIONS))
def test_allowed_values_of_a_table_file_are_documented(section: str) -> None:
    """The ends of each range are accepted, and values beyond them are refused by name."""
    made = SECTIONS[section]
    given = {item.name: 0 for item in fields(made) if item.default is MISSING}
    for key, (_, allowed, *_) in table_under(f'### `{section}`').items():
        match = re.fullmatch(r'(from |above )?(-?[\d.e-]+)(?: to ([\d.]+))?', allowed)
        if match is None:
            continue
        low, high = float(match[2]), float(match[3] or inf)
        if match[1] == 'above ':
            low = nextafter(low, inf)
        made(**{**given, key: low})
        for beyond in (nextafter(low, -inf), *([nextafter(high, inf)] if match[3] else ())):
            with pytest.raises(FourbarError, match=f'{section}.{key}'):
                made(**{**given, key: beyond})
        if match[3]:
            made(**{**given, key: high})


@pytest.mark.parametrize(('heading', 'kinds'), [
    ('### Of a link sensor', SENSOR_FAULTS), ('### Of a flywheel drive', WHEEL_FAULTS)])
def test_faults_are_documented(heading: str, kinds: Mapping[str, FaultKind]) -> None:
    """The page has exactly the kinds of the plant."""
    assert table_under(heading) == {
        name: [kind.meaning, kind.quantity, kind.unit,
               *(['', ''] if kind.default is None
                 else [f'{kind.default:g}', f'{kind.low:g} to {kind.high:g}'])]
        for name, kind in kinds.items()}


def test_schedule_of_the_page_is_valid(tmp_path: Path) -> None:
    block = re.search(r'```yaml\n(faults:.*?)```', (ROOT / 'docs' / 'table.md').read_text(),
                      re.DOTALL)
    assert block is not None
    path = tmp_path / 'faults.yaml'
    path.write_text(block[1])
    targets = (*LINK_NAMES, *FLYWHEEL_NAMES)
    assert len(parse_schedule(read_schedule(str(path)), targets, str(path))) == 2


def test_entries_of_the_energy_budget_are_documented() -> None:
    assert list(table_under('## Energy budget')) == [item.name for item in fields(EnergyBudget)]


@pytest.mark.parametrize('heading', ['## Motors', '## Mechanisms'])
def test_mechanisms_are_documented(heading: str) -> None:
    """The page has every value of the presets; their four links are equal."""
    presets = [load_yaml(config_file('mechanism', name)) for name in ('paper', 'prototype')]
    defaults = {item.name: item.default[0] for item in fields(Mechanism)
                if item.default is not MISSING}
    documented = table_under(heading)
    for key, cells in documented.items():
        if key == 'motor_*':
            continue
        for preset, cell in zip(presets, cells[-3:-1] if heading == '## Motors' else cells[1:]):
            values = preset.get(key, [defaults.get(key)] * 4)
            assert values == [values[0]] * 4
            expected = values[0] if isinstance(values[0], list) else [values[0]]
            assert [number(part) for part in cell.split(',')] == expected, key
    motors = {item.name for item in fields(Mechanism) if item.name.startswith('motor_')}
    assert set(documented) == (motors if heading == '## Motors' else {
        item.name for item in fields(Mechanism)} - motors | {'motor_*'})


def test_safety_rules_of_the_prototype_are_documented() -> None:
    """The page has every row of the table, with limit, time, reaction and least reaction."""
    text = (ROOT / 'docs' / 'hardware.md').read_text().split('## What stops what\n', 1)[1]
    documented = {}
    for line in re.findall(r'^\| `.*\|$', text.split('\n## ', 1)[0], re.MULTILINE):
        row, _, limit, lasting, reaction, least = (
            cell.strip() for cell in line.strip('|').split('|'))
        documented[row.strip('`')] = (
            *(float(re.findall('[0-9.]+', cell)[0]) if cell else 0.0 for cell in (limit, lasting)),
            re.split('[: ]', reaction)[0], least)
    table = load_safety('prototype')
    expected = {row: (rule.limit, rule.lasting, rule.reaction,
                      CONDITIONS[row].least.name.lower()) for row, rule in table.items()}
    # This rule only prevents arming and has no reaction.
    limit, lasting, *_ = expected['wheel_speed_to_arm']
    expected['wheel_speed_to_arm'] = (limit, lasting, 'refuses', 'refuses')
    assert documented == expected
