# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A mechanism is checked when it is made, cannot change afterwards, and says what is wrong."""

from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

from fourbar_ros.configuration import ConfigurationError
from fourbar_ros.errors import FourbarError
from fourbar_ros.mechanism import LINK_NAMES, load_mechanism, Mechanism, MechanismError
import numpy as np
import pytest

POSITIVE = (
    'link_lengths', 'link_masses', 'link_inertias', 'flywheel_inertias', 'motor_torque_limits',
    'motor_speed_limits')
FINITE = (*POSITIVE[:4], 'com_positions')
REQUIRED = FINITE


def described(**changes: Any) -> dict[str, Any]:
    """Describe a sound linkage, some of its keys changed."""
    values: dict[str, Any] = {
        'link_lengths': [0.12, 0.1, 0.11, 0.09],
        'link_masses': [0.02, 0.03, 0.025, 0.015],
        'link_inertias': [2.2e-5, 3e-5, 2.5e-5, 1.8e-5],
        'com_positions': [[0.062, 0.004], [0.047, -0.003], [0.055, 0.005], [0.046, 0.002]],
        'flywheel_inertias': [3.4e-7] * 4,
        'motor_torque_limits': [1e-4] * 4,
        'motor_speed_limits': [500.0] * 4,
    }
    return {**values, **changes}


def with_one(name: str, link: int, value: float) -> dict[str, Any]:
    """Describe a sound linkage, but for one number."""
    array = np.array(described()[name], dtype=float)
    array[link, ...] = value
    return described(**{name: array})


def test_sound_mechanism_keeps_every_value() -> None:
    mechanism = Mechanism(**described())
    for name, value in described().items():
        np.testing.assert_array_equal(getattr(mechanism, name), value, err_msg=name)


def test_fields_cannot_be_assigned() -> None:
    mechanism = Mechanism(**described())
    with pytest.raises(FrozenInstanceError):
        mechanism.link_masses = np.ones(4)  # type: ignore[misc]


@pytest.mark.parametrize('name', described())
def test_arrays_are_read_only(name: str) -> None:
    array = getattr(Mechanism(**described()), name)
    with pytest.raises(ValueError, match='read-only'):
        array[0] = 1.0


def test_array_of_the_caller_is_copied() -> None:
    masses = np.ones(4)
    mechanism = Mechanism(**described(link_masses=masses))
    masses[0] = 7.0
    assert mechanism.link_masses[0] == 1.0


def test_motors_are_unlimited_by_default() -> None:
    values = {name: described()[name] for name in REQUIRED}
    mechanism = Mechanism(**values)
    assert np.isinf(mechanism.motor_torque_limits).all()
    assert np.isinf(mechanism.motor_speed_limits).all()


@pytest.mark.parametrize('value', [0.0, -0.5])
@pytest.mark.parametrize('link', range(4))
@pytest.mark.parametrize('name', POSITIVE)
def test_value_that_is_not_positive_is_refused(name: str, link: int, value: float) -> None:
    with pytest.raises(MechanismError) as refusal:
        Mechanism(**with_one(name, link, value))
    assert f'{name} of {LINK_NAMES[link]} must be positive, got {value:g}' in str(refusal.value)


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('link', range(4))
@pytest.mark.parametrize('name', FINITE)
def test_value_that_is_not_finite_is_refused(name: str, link: int, value: float) -> None:
    with pytest.raises(MechanismError) as refusal:
        Mechanism(**with_one(name, link, value))
    assert f'{name} of {LINK_NAMES[link]} must be finite, got {value}' in str(refusal.value)


@pytest.mark.parametrize('value', [np.nan, -np.inf])
@pytest.mark.parametrize('name', ['motor_torque_limits', 'motor_speed_limits'])
def test_motor_limit_may_be_infinite_but_not_undefined(name: str, value: float) -> None:
    with pytest.raises(MechanismError, match=f'{name} of link_c must be finite, got {value}'):
        Mechanism(**with_one(name, 2, value))


def test_mass_centre_may_lie_anywhere() -> None:
    centres = [[-0.3, 0.0], [0.0, -0.2], [0.0, 0.0], [5.0, 1.0]]
    mechanism = Mechanism(**described(com_positions=centres))
    np.testing.assert_array_equal(mechanism.com_positions, centres)


@pytest.mark.parametrize('link', range(4))
@pytest.mark.parametrize('excess', [0.0, 0.05])
def test_lengths_that_cannot_close_are_refused(link: int, excess: float) -> None:
    lengths = np.full(4, 0.125)     # a power of two, so that three of them add up exactly
    lengths[link] = 0.375 + excess
    with pytest.raises(MechanismError) as refusal:
        Mechanism(**described(link_lengths=lengths))
    assert str(refusal.value) == (
        f'link_lengths cannot close: {LINK_NAMES[link]} is {lengths[link]:g} m long, '
        'the other three reach 0.375 m')


@pytest.mark.parametrize(('name', 'value', 'got'), [
    ('link_masses', 0.02, '()'),
    ('link_masses', [0.02] * 3, '(3,)'),
    ('link_masses', [[0.02] * 4], '(1, 4)'),
    ('com_positions', [0.05] * 4, '(4,)'),
    ('com_positions', [[0.05, 0.0, 0.0]] * 4, '(4, 3)'),
])
def test_wrong_shape_is_refused(name: str, value: Any, got: str) -> None:
    with pytest.raises(MechanismError) as refusal:
        Mechanism(**described(**{name: value}))
    expected = '(4, 2)' if name == 'com_positions' else '(4,)'
    assert str(refusal.value) == f'{name} must have shape {expected}, got {got}'


@pytest.mark.parametrize('value', ['heavy', [0.02, 0.02, 0.02, 'heavy'], {'a': 0.02},
                                   [[0.02, 0.02], 0.02, 0.02, 0.02]])
def test_what_is_no_number_is_refused(value: Any) -> None:
    with pytest.raises(MechanismError, match='link_masses must hold numbers, got'):
        Mechanism(**described(link_masses=value))


def test_errors_are_those_of_the_package() -> None:
    assert issubclass(MechanismError, FourbarError)


@pytest.mark.parametrize('name', REQUIRED)
def test_missing_key_is_named_with_its_file(name: str) -> None:
    values = described()
    del values[name]
    with pytest.raises(MechanismError, match=f'^bench.yaml: {name} missing$'):
        Mechanism.from_mapping(values, 'bench.yaml')


def test_unknown_key_is_named_with_its_file() -> None:
    with pytest.raises(MechanismError, match='^bench.yaml: unknown link_length [(]known are com'):
        Mechanism.from_mapping(described(link_length=[0.1] * 4), 'bench.yaml')


def test_refused_value_is_told_with_its_file() -> None:
    with pytest.raises(MechanismError, match='^bench.yaml: link_masses of link_b must be posi'):
        Mechanism.from_mapping(with_one('link_masses', 1, -1.0), 'bench.yaml')


def test_paper_preset_is_the_linkage_of_section_3() -> None:
    mechanism = load_mechanism('paper')
    np.testing.assert_array_equal(mechanism.link_lengths, [0.1] * 4)
    np.testing.assert_array_equal(mechanism.link_masses, [0.02] * 4)
    np.testing.assert_array_equal(mechanism.link_inertias, [2.2e-5] * 4)
    np.testing.assert_array_equal(mechanism.com_positions, [[0.05, 0.0]] * 4)
    np.testing.assert_array_equal(mechanism.flywheel_inertias, [3.4e-7] * 4)


def test_missing_preset_is_refused_with_those_there_are() -> None:
    with pytest.raises(ConfigurationError, match="'papre'.*paper"):
        load_mechanism('papre')


def test_mechanism_is_read_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / 'bench.yaml'
    file.write_text('\n'.join(f'{name}: {value}' for name, value in described().items()))
    np.testing.assert_array_equal(
        load_mechanism(str(file)).com_positions, described()['com_positions'])


def test_refusal_of_a_file_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / 'bench.yaml'
    values = described(link_masses=[0.02, 0.02, 0.02, 0.0])
    file.write_text('\n'.join(f'{name}: {value}' for name, value in values.items()))
    with pytest.raises(MechanismError, match='bench.yaml: link_masses of link_d must be positive'):
        load_mechanism(str(file))


def test_constants_have_the_symmetry_of_a_mass_matrix() -> None:
    """M_jk = M_kj for all angles needs a symmetric cosine part and an antisymmetric sine part."""
    constants = Mechanism(**described()).constants
    # Rounding of products of order 1e-4 kg m^2.
    np.testing.assert_allclose(constants.cosine, constants.cosine.T, rtol=0.0, atol=1e-18)
    np.testing.assert_allclose(constants.sine, -constants.sine.T, rtol=0.0, atol=1e-18)


def test_constants_do_not_depend_on_where_a_whole_mass_sits_alone() -> None:
    """With all mass in one link nothing but the four inertias is left about the mass centre."""
    masses = np.array([1.0, 1e-18, 1e-18, 1e-18])
    constants = Mechanism(**described(link_masses=masses)).constants
    # What is left of the light links: 1e-18 kg at 0.1 m.
    np.testing.assert_allclose(
        constants.cosine, np.diag(described()['link_inertias']), rtol=0.0, atol=1e-18)


def test_constants_are_worked_out_once() -> None:
    mechanism = Mechanism(**described())
    assert mechanism.constants is mechanism.constants


def test_total_mass_is_that_of_the_four_links() -> None:
    assert Mechanism(**described()).constants.total_mass == pytest.approx(0.09, rel=1e-15)
