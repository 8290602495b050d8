# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Table files: values, defaults, presets, and refusal with the name of the key."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from copy import deepcopy
from math import inf, nan, pi
from pathlib import Path
from typing import Any

from fourbar_ros.common.config_files import ConfigurationError, presets
from fourbar_ros.plant import load_table, Table, TableError
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import quantum, WheelEncoders
import pytest
import yaml

Refuses = Callable[..., AbstractContextManager[None]]
GOOD = {
    'link_sensors': {'noise_rms': 1e-3, 'counts_per_turn': 4096},
    'wheel_encoders': {'counts_per_turn': 0},
}
PLACES = [(section, key) for section, keys in GOOD.items() for key in keys]
each_value = pytest.mark.parametrize(('section', 'key'), PLACES)


@pytest.fixture
def written(tmp_path: Path) -> Callable[[Any], str]:
    """Return a function that writes a table file and returns its path."""
    def write(content: Any) -> str:
        path = tmp_path / 'table.yaml'
        path.write_text(yaml.safe_dump(content))
        return str(path)
    return write


def with_value(section: str, key: str, value: Any) -> dict[str, Any]:
    content: dict[str, Any] = deepcopy(GOOD)
    content[section][key] = value
    return content


def test_values_are_read(written: Callable[[Any], str]) -> None:
    assert load_table(written(GOOD)) == Table(
        LinkSensorSettings(noise_rms=1e-3, counts_per_turn=4096), WheelEncoders(0))


def test_every_preset_loads() -> None:
    names = presets('table')
    assert 'ideal' in names
    for name in names:
        assert isinstance(load_table(name), Table)


def test_ideal_table_has_the_sensors_of_the_design() -> None:
    table = load_table('ideal')
    assert table.link_sensors.noise_rms == pytest.approx(0.1 * pi / 180.0, rel=1e-4)
    assert table.link_sensors.counts_per_turn == table.wheel_encoders.counts_per_turn == 2 ** 14


@each_value
@pytest.mark.parametrize('value', [-1, nan, inf, '1', True, None, [1], {}])
def test_bad_value_is_refused_by_name(
    section: str, key: str, value: Any, written: Callable[[Any], str], refuses: Refuses,
) -> None:
    path = written(with_value(section, key, value))
    same = pytest.approx(value, nan_ok=True) if isinstance(value, float) else value
    with refuses(TableError, name=f'{section}.{key}', value=same, place=path):
        load_table(path)


@pytest.mark.parametrize('section', list(GOOD))
def test_half_a_count_is_refused(
    section: str, written: Callable[[Any], str], refuses: Refuses,
) -> None:
    with refuses(TableError, name=f'{section}.counts_per_turn', value=16.5, limit=int):
        load_table(written(with_value(section, 'counts_per_turn', 16.5)))


def test_missing_key_is_named(written: Callable[[Any], str], refuses: Refuses) -> None:
    with refuses(TableError, missing=['counts_per_turn'], place='wheel_encoders'):
        load_table(written({**GOOD, 'wheel_encoders': {}}))


@pytest.mark.parametrize(('section', 'key', 'value', 'limit'), [
    ('link_sensors', 'dropout', 1.5, (0.0, 1.0)),
    ('link_sensors', 'kind', 'sundial', ('absolute', 'joint')),
    ('link_sensors', 'latency', -1e-3, (0.0, 10.0)),
    ('wheel_bearings', 'viscous', -1e-6, (0.0, inf)),
    ('wheel_bearings', 'coulomb', nan, (0.0, inf)),
    ('wheel_bearings', 'static_ratio', 0.9, (1.0, inf)),
    ('wheel_bearings', 'stribeck_speed', 0.0, (1e-6, inf)),
    ('wheel_bearings', 'smoothing', 0.0, (1e-6, inf)),
    ('joints', 'viscous', '1', float), ('joints', 'coulomb', True, float),
    ('joints', 'static_ratio', inf, (1.0, inf)), ('joints', 'stribeck_rate', -0.1, (1e-6, inf)),
    ('joints', 'smoothing', 0.0, (1e-6, inf)), ('links', 'drag', -1.0, (0.0, inf)),
    ('links', 'spin_drag', None, float), ('surface', 'tilt_x', 0.2, (-0.1, 0.1)),
    ('surface', 'tilt_y', nan, (-0.1, 0.1)), ('surface', 'size_x', -1.0, (0.0, inf)),
    ('surface', 'size_y', 0.0, (0.0, inf)), ('surface', 'restitution', 1.1, (0.0, 1.0)),
    ('disturbance', 'torque_density', -1e-7, (0.0, inf)),
    ('disturbance', 'torque_walk', -1e-7, (0.0, inf))])
def test_bad_effect_is_refused_by_name_with_its_limit(
    section: str, key: str, value: Any, limit: Any, written: Callable[[Any], str],
    refuses: Refuses,
) -> None:
    path = written({**GOOD, section: {key: value}})
    same = pytest.approx(value, nan_ok=True) if isinstance(value, float) else value
    with refuses(TableError, name=f'{section}.{key}', value=same, limit=limit, place=path):
        load_table(path)


def test_missing_effects_are_zero(written: Callable[[Any], str]) -> None:
    table = load_table(written(GOOD))
    assert table == load_table(written({
        **GOOD, 'wheel_bearings': {}, 'joints': {}, 'links': {}, 'surface': {},
        'disturbance': {}}))
    assert (table.wheel_bearings.coulomb, table.joints.viscous, table.links.drag) == (0, 0, 0)
    assert table.surface.size_x == float('inf')


def test_prototype_table_has_the_effects_of_the_design() -> None:
    table = load_table('prototype')
    assert (table.joints.coulomb, table.wheel_bearings.coulomb) == (2e-4, 1e-3)
    assert table.surface.tilt_x == 2e-5
    assert (table.surface.size_x, table.surface.size_y) == (2.0, 2.0)


@pytest.mark.parametrize('section', list(GOOD))
def test_missing_section_is_named(
    section: str, written: Callable[[Any], str], refuses: Refuses,
) -> None:
    content = {name: keys for name, keys in GOOD.items() if name != section}
    with refuses(TableError, missing=[section]):
        load_table(written(content))


@pytest.mark.parametrize('section', list(GOOD))
def test_section_without_keys_is_refused(
    section: str, written: Callable[[Any], str], refuses: Refuses,
) -> None:
    with refuses(TableError, name=section, value=3, limit=dict):
        load_table(written({**GOOD, section: 3}))


def test_unknown_section_is_named(written: Callable[[Any], str], refuses: Refuses) -> None:
    with refuses(TableError, unknown=['joint_friktion']):
        load_table(written({**GOOD, 'joint_friktion': {}}))


@pytest.mark.parametrize('section', list(GOOD))
def test_unknown_key_is_named(
    section: str, written: Callable[[Any], str], refuses: Refuses,
) -> None:
    with refuses(TableError, unknown=['nois_rms'], place=section):
        load_table(written(with_value(section, 'nois_rms', 1)))


def test_missing_file_is_refused() -> None:
    with pytest.raises(ConfigurationError):
        load_table('no_such_table')


def test_resolution_is_a_full_turn() -> None:
    assert quantum(0) == 0.0
    assert quantum(16384) * 16384 == pytest.approx(2.0 * pi, rel=1e-15)
