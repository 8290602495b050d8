# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A mechanism is checked when it is made and cannot change afterwards."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import FrozenInstanceError
from math import inf, nan
from pathlib import Path
from typing import Any

from fourbar_ros.common.config_files import ConfigurationError
from fourbar_ros.common.settings import SettingError
from fourbar_ros.mechanism import LINK_NAMES, load_mechanism, Mechanism, MechanismError
import numpy as np
import pytest

Refuses = Callable[..., AbstractContextManager[None]]
POSITIVE = (
    'link_lengths', 'link_masses', 'link_inertias', 'flywheel_inertias', 'motor_torque_limits',
    'motor_speed_limits')
FINITE = (*POSITIVE[:4], 'com_positions')
REQUIRED = FINITE


def described(**changes: Any) -> dict[str, Any]:
    """Return the description of a valid linkage with some changed keys."""
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
    """Return the description of a valid linkage with one changed number."""
    array = np.array(described()[name], dtype=float)
    array[link, ...] = value
    return described(**{name: array})


def test_valid_mechanism_has_every_value() -> None:
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
def test_value_that_is_not_positive_is_refused(
    name: str, link: int, value: float, refuses: Refuses,
) -> None:
    with refuses(SettingError, name=f'{name}.{LINK_NAMES[link]}', value=value, limit=(0.0, inf)):
        Mechanism(**with_one(name, link, value))


@pytest.mark.parametrize('value', [nan, inf, -inf])
@pytest.mark.parametrize('link', range(4))
@pytest.mark.parametrize('name', FINITE)
def test_value_that_is_not_finite_is_refused(
    name: str, link: int, value: float, refuses: Refuses,
) -> None:
    place = f'{name}.{LINK_NAMES[link]}' + ('.x' if name == 'com_positions' else '')
    with refuses(SettingError, name=place, value=pytest.approx(value, nan_ok=True)):
        Mechanism(**with_one(name, link, value))


@pytest.mark.parametrize('value', [nan, -inf])
@pytest.mark.parametrize('name', ['motor_torque_limits', 'motor_speed_limits'])
def test_motor_limit_may_be_infinite_but_not_undefined(
    name: str, value: float, refuses: Refuses,
) -> None:
    with refuses(SettingError, name=f'{name}.link_c', value=pytest.approx(value, nan_ok=True)):
        Mechanism(**with_one(name, 2, value))


def test_mass_centre_may_lie_anywhere() -> None:
    centres = [[-0.3, 0.0], [0.0, -0.2], [0.0, 0.0], [5.0, 1.0]]
    mechanism = Mechanism(**described(com_positions=centres))
    np.testing.assert_array_equal(mechanism.com_positions, centres)


def test_sensors_have_no_offset_by_default() -> None:
    values = {name: described()[name] for name in REQUIRED}
    np.testing.assert_array_equal(Mechanism(**values).link_angle_offsets, np.zeros(4))


def test_offset_of_a_sensor_may_be_negative_but_must_be_known(refuses: Refuses) -> None:
    offsets = [0.01, -0.02, 0.0, 3.0]
    values = described(link_angle_offsets=offsets)
    np.testing.assert_array_equal(
        Mechanism.from_mapping(values, 'file').link_angle_offsets, offsets)
    for value in (nan, inf, -inf):
        with refuses(SettingError, name='link_angle_offsets.link_b', value=value):
            Mechanism(**described(link_angle_offsets=[0.0, value, 0.0, 0.0]))


@pytest.mark.parametrize('link', range(4))
@pytest.mark.parametrize('excess', [0.0, 0.05])
def test_lengths_that_cannot_close_are_refused(
    link: int, excess: float, refuses: Refuses,
) -> None:
    lengths = np.full(4, 0.125)     # a power of two, so that the sum of three is exact
    lengths[link] = 0.375 + excess
    with refuses(MechanismError, name=f'link_lengths.{LINK_NAMES[link]}',
                 value=float(lengths[link]), limit=0.375):
        Mechanism(**described(link_lengths=lengths))


@pytest.mark.parametrize(('name', 'value', 'values'), [
    ('link_masses', 0.02, {'name': 'link_masses', 'value': 0.02, 'limit': list}),
    ('link_masses', [0.02] * 3, {'name': 'link_masses', 'value': 3, 'limit': 4}),
    ('link_masses', [[0.02] * 4], {'name': 'link_masses', 'value': 1, 'limit': 4}),
    ('com_positions', [0.05] * 4, {'name': 'com_positions.link_a', 'value': 0.05}),
    ('com_positions', [[0.05, 0.0, 0.0]] * 4,
     {'name': 'com_positions.link_a', 'value': 3, 'limit': 2}),
])
def test_wrong_shape_is_refused(
    name: str, value: Any, values: dict[str, Any], refuses: Refuses,
) -> None:
    with refuses(SettingError, **values):
        Mechanism(**described(**{name: value}))


@pytest.mark.parametrize(('value', 'name'), [
    ('heavy', 'link_masses'), ([0.02, 0.02, 0.02, 'heavy'], 'link_masses.link_d'),
    ({'a': 0.02}, 'link_masses'), ([[0.02, 0.02], 0.02, 0.02, 0.02], 'link_masses.link_a')])
def test_value_that_is_no_number_is_refused(value: Any, name: str, refuses: Refuses) -> None:
    with refuses(SettingError, name=name):
        Mechanism(**described(link_masses=value))


@pytest.mark.parametrize('name', REQUIRED)
def test_missing_key_is_named(name: str, refuses: Refuses) -> None:
    values = described()
    del values[name]
    with refuses(MechanismError, missing=[name], place='mechanism'):
        Mechanism.from_mapping(values, 'bench.yaml')


def test_unknown_key_is_named(refuses: Refuses) -> None:
    with refuses(MechanismError, unknown=['link_length'], place='mechanism'):
        Mechanism.from_mapping(described(link_length=[0.1] * 4), 'bench.yaml')


def test_refused_value_is_named_with_its_file(refuses: Refuses) -> None:
    with refuses(MechanismError, name='link_masses.link_b', value=-1.0, place='bench.yaml'):
        Mechanism.from_mapping(with_one('link_masses', 1, -1.0), 'bench.yaml')


def test_paper_preset_is_the_linkage_of_section_3() -> None:
    mechanism = load_mechanism('paper')
    np.testing.assert_array_equal(mechanism.link_lengths, [0.1] * 4)
    np.testing.assert_array_equal(mechanism.link_masses, [0.02] * 4)
    np.testing.assert_array_equal(mechanism.link_inertias, [2.2e-5] * 4)
    np.testing.assert_array_equal(mechanism.com_positions, [[0.05, 0.0]] * 4)
    np.testing.assert_array_equal(mechanism.flywheel_inertias, [3.4e-7] * 4)


def test_missing_preset_is_refused() -> None:
    with pytest.raises(ConfigurationError):
        load_mechanism('papre')


def test_mechanism_is_read_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / 'bench.yaml'
    file.write_text('\n'.join(f'{name}: {value}' for name, value in described().items()))
    np.testing.assert_array_equal(
        load_mechanism(str(file)).com_positions, described()['com_positions'])


def test_refusal_of_a_file_names_the_file(tmp_path: Path, refuses: Refuses) -> None:
    file = tmp_path / 'bench.yaml'
    values = described(link_masses=[0.02, 0.02, 0.02, 0.0])
    file.write_text('\n'.join(f'{name}: {value}' for name, value in values.items()))
    with refuses(MechanismError, name='link_masses.link_d', value=0.0, place=str(file)):
        load_mechanism(str(file))


def test_constants_have_the_symmetry_of_a_mass_matrix() -> None:
    """By M_jk = M_kj the cosine part is symmetric and the sine part antisymmetric."""
    constants = Mechanism(**described()).constants
    # Rounding of products of order 1e-4 kg m^2.
    np.testing.assert_allclose(constants.cosine, constants.cosine.T, rtol=0.0, atol=1e-18)
    np.testing.assert_allclose(constants.sine, -constants.sine.T, rtol=0.0, atol=1e-18)


def test_constants_of_a_single_mass_do_not_depend_on_its_position() -> None:
    """With all mass in one link only the four inertias remain about the mass centre."""
    masses = np.array([1.0, 1e-18, 1e-18, 1e-18])
    constants = Mechanism(**described(link_masses=masses)).constants
    # The other links have 1e-18 kg at 0.1 m.
    np.testing.assert_allclose(
        constants.cosine, np.diag(described()['link_inertias']), rtol=0.0, atol=1e-18)


def test_constants_are_computed_once() -> None:
    mechanism = Mechanism(**described())
    assert mechanism.constants is mechanism.constants


def test_total_mass_is_that_of_the_four_links() -> None:
    assert Mechanism(**described()).constants.total_mass == pytest.approx(0.09, rel=1e-15)


@pytest.mark.parametrize(('changes', 'name'), [
    ({'joint_stiffness': [1e4, 1e4, inf, 1e4]}, 'joint_stiffness.joint_3'),
    ({'joint_stiffness': [inf, inf, 1e4, inf]}, 'joint_stiffness.joint_1'),
    ({'joint_stiffness': [1e4, 0.0, 1e4, 1e4]}, 'joint_stiffness.joint_2'),
    ({'joint_stiffness': [-1e4, 1e4, 1e4, 1e4]}, 'joint_stiffness.joint_1'),
    ({'joint_stiffness': [1e4, 1e4, 1e4, nan]}, 'joint_stiffness.joint_4'),
    ({'joint_stiffness': [-inf] * 4}, 'joint_stiffness.joint_1'),
    ({'joint_stiffness': 1e4}, 'joint_stiffness'),
    ({'motor_time_constants': [0.0, -1e-3, 0.0, 0.0]}, 'motor_time_constants.link_b'),
    ({'motor_resistances': [0.0, 0.0, inf, 0.0]}, 'motor_resistances.link_c'),
    ({'motor_torque_constants': [0.0, 1.0, 1.0, 1.0]}, 'motor_torque_constants.link_a'),
    ({'motor_voltages': [12.0, 12.0, 12.0, nan]}, 'motor_voltages.link_d'),
    ({'joint_stiffness': [1e4] * 4, 'joint_damping': [0.0, 0.0, -1.0, 0.0]},
     'joint_damping.joint_3'),
    ({'joint_stiffness': [1e4] * 4, 'joint_damping': [0.0, inf, 0.0, 0.0]},
     'joint_damping.joint_2'),
    ({'joint_stiffness': [1e4] * 4, 'joint_damping': [1.0] * 3}, 'joint_damping'),
])
def test_impossible_joints_and_windings_are_refused(
    changes: dict[str, Any], name: str, refuses: Refuses,
) -> None:
    with refuses(SettingError, name=name):
        Mechanism(**described(**changes))


@pytest.mark.parametrize(('changes', 'name', 'missing'), [
    ({'motor_voltages': [inf, 12.0, inf, inf]}, 'motor_voltages.link_b',
     'motor_torque_constants'),
    ({'motor_resistances': [0.0, 0.0, 1.0, 0.0]}, 'motor_resistances.link_c',
     'motor_torque_constants'),
    ({'motor_voltages': [12.0] * 4, 'motor_torque_constants': [0.03] * 4},
     'motor_voltages.link_a', 'motor_resistances'),
    ({'joint_damping': [0.0, 1.0, 0.0, 0.0]}, 'joint_damping.joint_2', 'joint_stiffness'),
])
def test_value_that_needs_another_is_refused(
    changes: dict[str, Any], name: str, missing: str, refuses: Refuses,
) -> None:
    with refuses(MechanismError, name=name, missing=missing):
        Mechanism(**described(**changes))


@pytest.mark.parametrize('damping', [None, [0.0] * 4])
def test_rigid_joints_may_be_given_explicitly(damping: list[float] | None) -> None:
    given = {} if damping is None else {'joint_damping': damping}
    assert not Mechanism(**described(joint_stiffness=[np.inf] * 4, **given)).constants.compliant


def test_compliant_joints_need_no_damping() -> None:
    mechanism = Mechanism(**described(joint_stiffness=[1e4, 2e4, 3e4, 4e4]))
    np.testing.assert_array_equal(mechanism.joint_damping, [0.0] * 4)
    np.testing.assert_array_equal(mechanism.constants.joint_stiffness, [1e4, 2e4, 3e4, 4e4])


def test_joints_are_read_from_a_file_and_refused_with_it(
    tmp_path: Path, refuses: Refuses,
) -> None:
    file = tmp_path / 'bench.yaml'

    def describe(stiffness: str) -> None:
        values = {**described(), 'joint_stiffness': stiffness}
        file.write_text('\n'.join(f'{name}: {value}' for name, value in values.items()))

    describe('[10000.0, 20000.0, 30000.0, 40000.0]')
    np.testing.assert_array_equal(
        load_mechanism(str(file)).joint_stiffness, [1e4, 2e4, 3e4, 4e4])
    describe('[10000.0, 20000.0, 0.0, 40000.0]')
    with refuses(MechanismError, name='joint_stiffness.joint_3', value=0.0, place=str(file)):
        load_mechanism(str(file))


def test_rigid_joints_change_no_other_value() -> None:
    soft = Mechanism(**described(joint_stiffness=[1e4] * 4, joint_damping=[1.0] * 4))
    rigid = soft.with_rigid_joints()
    for name, value in described().items():
        np.testing.assert_array_equal(getattr(rigid, name), value, err_msg=name)


@pytest.mark.parametrize('seed', range(10))
def test_bound_of_the_joint_modes(seed: int) -> None:
    """
    The reference is frequencies of four bodies on springs and decay rates of dampers.

    They are eigenvalues of the linear motion about an almost closed loop, from the joint forces of
    unit displacements of each coordinate.
    """
    rng = np.random.default_rng(seed)
    stiffness, damping = 10.0**rng.uniform(2.0, 6.0, 4), 10.0**rng.uniform(-2.0, 2.0, 4)
    mechanism = Mechanism(**described(joint_stiffness=stiffness, joint_damping=damping))
    turn = np.exp(1j * rng.uniform(-np.pi, np.pi, 4))
    lengths, centres = mechanism.link_lengths, mechanism.com_positions @ [1.0, 1j]
    # Rows: x and y of each joint; columns: x, y and angle of each body.
    opening = np.zeros((8, 12))
    for joint, (first, second) in enumerate((
            ((0, 0.0), (1, 0.0)), ((1, lengths[1]), (2, 0.0)),
            ((3, lengths[3]), (2, lengths[2])), ((0, lengths[0]), (3, 0.0)))):
        for (link, along), sign in ((first, -1.0), (second, 1.0)):
            arm = 1j * turn[link] * (along - centres[link])
            opening[2 * joint:2 * joint + 2, 3 * link:3 * link + 2] = sign * np.eye(2)
            opening[2 * joint:2 * joint + 2, 3 * link + 2] = sign * arm.real, sign * arm.imag
    inertia = np.column_stack(
        [mechanism.link_masses, mechanism.link_masses, mechanism.link_inertias]).ravel()
    fastest = []
    for weight in (stiffness, damping):
        scaled = np.sqrt(np.repeat(weight, 2))[:, np.newaxis] * opening / np.sqrt(inertia)
        fastest.append(np.linalg.norm(scaled, 2)**2)
    bound = mechanism.constants.fastest_joint_mode
    assert max(np.sqrt(fastest[0]), fastest[1]) <= bound
    # The bound by Gershgorin's discs of eight rows is too large by at most eight.
    assert bound <= 8.0 * max(np.sqrt(fastest[0]), fastest[1])


def test_joints_are_rigid_by_default() -> None:
    rigid = Mechanism(**described())
    soft = Mechanism(**described(joint_stiffness=[1e4] * 4, joint_damping=[1.0] * 4))
    assert not rigid.constants.compliant
    assert soft.constants.compliant
    assert not soft.with_rigid_joints().constants.compliant


def test_prescribed_wheels_turn_with_their_links() -> None:
    """Only the axial inertia of prescribed wheels is added to that of the link."""
    mechanism = Mechanism(**described())
    given = np.array([True, False, False, True])
    added = np.diag(mechanism.constants_with(given).cosine - mechanism.constants.cosine)
    np.testing.assert_allclose(
        added, np.where(given, mechanism.flywheel_inertias, 0.0), rtol=0.0, atol=1e-18)


@pytest.mark.parametrize('signs', [(1, -1, -1, 1), (1, 1, -1, -1), (1, -1, 1, -1)])
def test_lengths_with_a_mismatch_within_rounding_are_matched(
    signs: tuple[int, ...],
) -> None:
    """Mismatches within 1e-8 of the mean length are removed; larger ones are kept."""
    lengths = np.array([0.12, 0.1, 0.14, 0.09])
    lengths -= np.dot(signs, lengths) / 4.0 * np.array(signs)
    one = np.array([0.0, 0.0, lengths.mean(), 0.0])
    for mismatch in (9e-9, -1e-12):
        almost = lengths + mismatch * one
        matched = Mechanism(**described(link_lengths=almost)).link_lengths
        assert abs(np.dot(signs, matched)) < 1e-16
        np.testing.assert_allclose(matched, almost, rtol=0.0, atol=1e-8 * 0.1)
    missed = lengths + 1.1e-8 * one
    np.testing.assert_array_equal(
        Mechanism(**described(link_lengths=missed)).link_lengths, missed)
