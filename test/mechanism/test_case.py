# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Case files: valid and invalid ones, prescribed wheels, and the branch of a motion."""

from collections.abc import Callable
from contextlib import AbstractContextManager
import json
from math import inf, nan
from pathlib import Path
from typing import Any

from fourbar_ros.mechanism import ClosureError, FLYWHEEL_NAMES, load_mechanism
from fourbar_ros.mechanism.case import Case, CaseError, load_case, simulate
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Refuses = Callable[..., AbstractContextManager[None]]
NONE = np.zeros(4)
REFERENCE = Path(__file__).parents[2] / 'config' / 'reference'
COSINE = {'amplitude': [10.0], 'frequency_hz': [0.5], 'phase': [0.0]}


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes a case of the linkage of the paper with some changed keys."""
    paper = load_mechanism('paper')
    names = ('link_lengths', 'link_masses', 'link_inertias', 'com_positions', 'flywheel_inertias')

    def write_case(**changes: Any) -> Path:
        values = {
            'mechanism': {name: getattr(paper, name).tolist() for name in names},
            'initial': {'link_angles': [0.0, 1.0, 0.0, 1.0]}, 't': [0.0, 0.5, 1.0],
            'motor_torque': {name: [0.0] * 4 for name in COSINE}, **changes}
        path = tmp_path / 'case.json'
        path.write_text(json.dumps({k: v for k, v in values.items() if v is not None}))
        return path
    return write_case


# --- Good files -------------------------------------------------------------------------------

def test_values_of_a_file_are_read(write: Callable[..., Path]) -> None:
    torque = {'amplitude': [1e-5, 2e-5, 3e-5, 4e-5], 'frequency_hz': [0.1, 0.2, 0.3, 0.4],
              'phase': [1.0, 2.0, 3.0, 4.0]}
    initial = {'link_angles': [0.1, 1.0, 0.1, 1.0], 'link_rates': [0.2, 0.3, 0.2, 0.3],
               'flywheel_speeds_absolute': [5.0, 6.0, 7.0, 8.0]}
    case = load_case(write(initial=initial, motor_torque=torque, t=[1.0, 2.0, 2.5]))
    for name, value in {**torque, **initial, 'times': [1.0, 2.0, 2.5]}.items():
        np.testing.assert_array_equal(getattr(case, name), value, err_msg=name)
    np.testing.assert_array_equal(case.mechanism.link_masses, [0.02] * 4)
    assert not case.prescribed.any()


def test_rates_and_wheel_speeds_are_zero_by_default(write: Callable[..., Path]) -> None:
    case = load_case(write())
    np.testing.assert_array_equal(case.link_rates, NONE)
    np.testing.assert_array_equal(case.flywheel_speeds_absolute, NONE)


def test_other_keys_are_ignored(write: Callable[..., Path]) -> None:
    """A file may contain expected results and a description."""
    write_expected = write(note='from elsewhere', link_angles=[[0.0] * 4] * 3)
    assert load_case(write_expected).times.size == 3


@pytest.mark.parametrize('path', sorted(REFERENCE.glob('*.json')), ids=lambda path: path.stem)
def test_reference_motions_can_be_read(path: Path) -> None:
    assert load_case(path).times[0] == 0.0


def test_wheel_angle_in_a_file_moves_the_wheel(write: Callable[..., Path]) -> None:
    angle = {'flywheels': ['flywheel_b'], **COSINE}
    motion = simulate(load_case(write(wheel_angle=angle)))
    # The law is 10 cos(pi t), up to a constant.
    np.testing.assert_allclose(
        motion.flywheel_angles[:, 1], [0.0, -10.0, -20.0], rtol=0.0, atol=1e-9)
    # A wheel without torque keeps its orientation in the table frame.
    np.testing.assert_allclose(
        motion.flywheel_angles[:, 0], -motion.link_angles[:, 0], rtol=0.0, atol=1e-12)


def test_laws_belong_to_the_wheels_in_the_order_named(write: Callable[..., Path]) -> None:
    angle = {'flywheels': ['flywheel_d', 'flywheel_b'], 'amplitude': [4.0, 2.0],
             'frequency_hz': [0.4, 0.2], 'phase': [1.0, 0.5]}
    torque = {'amplitude': [1e-5, 0.0, 3e-5, 0.0], 'frequency_hz': [0.1, 0.0, 0.3, 0.0],
              'phase': [0.0] * 4}
    case = load_case(write(wheel_angle=angle, motor_torque=torque))
    np.testing.assert_array_equal(case.prescribed, [False, True, False, True])
    np.testing.assert_array_equal(case.amplitude, [1e-5, 2.0, 3e-5, 4.0])
    np.testing.assert_array_equal(case.frequency_hz, [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(case.phase, [0.0, 0.5, 0.0, 1.0])


def test_prescribed_wheel_starts_at_the_speed_of_its_law(write: Callable[..., Path]) -> None:
    """The speed of the initial state is ignored; at 0.25 s the law has its peak speed."""
    initial = {'link_angles': [0.0, 1.0, 0.0, 1.0], 'link_rates': [0.3, 0.0, 0.3, 0.0],
               'flywheel_speeds_absolute': [77.0] * 4}
    angle = {'flywheels': ['flywheel_a'], 'amplitude': [10.0], 'frequency_hz': [1.0],
             'phase': [0.0]}
    motion = simulate(load_case(write(initial=initial, wheel_angle=angle, t=[0.25, 0.5])))
    assert motion.flywheel_speeds_absolute[0, 0] == pytest.approx(0.3 - 20.0 * np.pi, rel=1e-14)
    np.testing.assert_array_equal(motion.flywheel_speeds_absolute[0, 1:], [77.0] * 3)
    # The change is 10 cos(pi) - 10 cos(pi / 2), with a relative error of 1e-12.
    assert motion.flywheel_angles[1, 0] == pytest.approx(-10.0, rel=1e-10)


def test_four_prescribed_wheels_need_no_torque(write: Callable[..., Path]) -> None:
    cosine = {name: value * 4 for name, value in COSINE.items()}
    angle = {'flywheels': [f'flywheel_{letter}' for letter in 'abcd'], **cosine}
    assert load_case(write(wheel_angle=angle, motor_torque=None)).prescribed.all()


def test_motion_begins_with_the_initial_state_at_the_given_times(
    write: Callable[..., Path],
) -> None:
    initial = {'link_angles': [0.1, 1.0, 0.1, 1.0], 'link_rates': [0.2, 0.3, 0.2, 0.3],
               'flywheel_speeds_absolute': [5.0, 6.0, 7.0, 8.0]}
    motion = simulate(load_case(write(initial=initial)))
    np.testing.assert_array_equal(motion.times, [0.0, 0.5, 1.0])
    for name, value in initial.items():
        np.testing.assert_array_equal(getattr(motion, name)[0], value, err_msg=name)
    np.testing.assert_array_equal(motion.flywheel_angles[0], NONE)


# --- Bad files --------------------------------------------------------------------------------

@pytest.mark.parametrize(('changes', 'values'), [
    ({'wheel_angle': {'flywheels': ['flywheel_x'], **COSINE}},
     {'name': 'flywheels', 'value': 'flywheel_x', 'limit': FLYWHEEL_NAMES}),
    ({'wheel_angle': {'flywheels': ['link_a'], **COSINE}}, {'value': 'link_a'}),
    ({'wheel_angle': {'flywheels': [0], **COSINE}}, {'value': 0}),
    ({'wheel_angle': {'flywheels': [['flywheel_a']], **COSINE}}, {'value': ['flywheel_a']}),
    ({'wheel_angle': {'flywheels': ['flywheel_a'] * 2, **COSINE}},
     {'name': 'flywheels', 'value': ['flywheel_a', 'flywheel_a']}),
    ({'wheel_angle': {'flywheels': [], **COSINE}}, {'name': 'flywheels', 'value': []}),
    ({'wheel_angle': {'flywheels': 'flywheel_a', **COSINE}},
     {'name': 'flywheels', 'value': 'flywheel_a'}),
    ({'wheel_angle': COSINE}, {'name': 'flywheels', 'value': None}),
    ({'wheel_angle': ['flywheel_a']}, {'name': 'wheel_angle'}),
    ({'wheel_angle': {'flywheels': ['flywheel_a', 'flywheel_b'], **COSINE}},
     {'name': 'amplitude', 'value': 1, 'limit': 2}),
    ({'wheel_angle': {'flywheels': ['flywheel_a'], **COSINE, 'phase': 1.0}},
     {'name': 'phase', 'value': 1.0, 'limit': list}),
    ({'wheel_angle': {'flywheels': ['flywheel_a'], **COSINE, 'frequency_hz': [inf]}},
     {'name': 'frequency_hz.flywheel_a', 'value': inf}),
    ({'wheel_angle': {'flywheels': ['flywheel_a'], 'amplitude': [1.0], 'phase': [0.0]}},
     {'name': 'frequency_hz'}),
    ({'wheel_angle': {'flywheels': ['flywheel_c', 'flywheel_a'], 'amplitude': [1.0, 1.0],
                      'frequency_hz': [1.0, 1.0], 'phase': [0.0, 0.0]}, 'motor_torque': {
        'amplitude': [1.0, 0.0, 0.0, 0.0], 'frequency_hz': [1.0] * 4, 'phase': [0.0] * 4}},
     {'name': 'flywheel_a'}),
    ({'motor_torque': None}, {'name': 'motor_torque', 'value': None}),
    ({'motor_torque': None, 'wheel_angle': {'flywheels': ['flywheel_a'], **COSINE}},
     {'name': 'motor_torque'}),
    ({'motor_torque': {'amplitude': [1.0] * 3, 'frequency_hz': [1.0] * 4, 'phase': [0.0] * 4}},
     {'name': 'amplitude', 'value': 3, 'limit': 4}),
    ({'motor_torque': {'amplitude': ['1'] * 4, 'frequency_hz': [1.0] * 4, 'phase': [0.0] * 4}},
     {'name': 'amplitude.flywheel_a', 'value': '1'}),
    ({'motor_torque': {'amplitude': [True] * 4, 'frequency_hz': [1.0] * 4, 'phase': [0.0] * 4}},
     {'name': 'amplitude.flywheel_a', 'value': True}),
    ({'initial': None}, {'name': 'initial'}),
    ({'initial': {}}, {'name': 'link_angles'}),
    ({'initial': {'link_angles': [0.0, 1.0, 0.1, 1.0]}},
     {'name': 'link_angles', 'value': pytest.approx(0.01, rel=1e-3),
      'limit': pytest.approx(1e-7)}),
    ({'initial': {'link_angles': [0.0, 1.0, 0.0, 1.0], 'link_rates': [0.0, 1.0, 0.0, 0.0]}},
     {'name': 'link_rates', 'value': pytest.approx(0.1), 'limit': pytest.approx(1e-7)}),
    ({'initial': {'link_angles': [0.0, 1.0, 0.0, nan]}},
     {'name': 'link_angles.link_d', 'value': pytest.approx(nan, nan_ok=True)}),
    ({'initial': {'link_angles': [0.0, 1.0, 0.0, 1.0],
                  'flywheel_speeds_absolute': [0.0] * 5}},
     {'name': 'flywheel_speeds_absolute', 'value': 5, 'limit': 4}),
    ({'t': None}, {'name': 't', 'value': None}),
    ({'t': [0.0]}, {'name': 't'}),
    ({'t': []}, {'name': 't'}),
    ({'t': [0.0, 1.0, 1.0]}, {'name': 't'}),
    ({'t': [[0.0], [1.0]]}, {'name': 't.0', 'value': [0.0]}),
    ({'t': [0.0, inf]}, {'name': 't.1', 'value': inf}),
    ({'mechanism': 'paper'}, {'name': 'mechanism', 'value': 'paper'}),
])
def test_bad_files_are_refused(
    changes: dict[str, Any], values: dict[str, Any], write: Callable[..., Path], refuses: Refuses,
) -> None:
    path = write(**changes)
    with refuses(CaseError, place=str(path), **values):
        load_case(path)


def test_torque_on_one_of_four_prescribed_wheels_is_refused(
    write: Callable[..., Path], refuses: Refuses,
) -> None:
    """The refusal is the same as for three prescribed wheels."""
    cosine = {name: value * 4 for name, value in COSINE.items()}
    angle = {'flywheels': list(FLYWHEEL_NAMES), **cosine}
    torque = {**cosine, 'amplitude': [0.0, 1.0, 0.0, 0.0]}
    with refuses(CaseError, name='flywheel_b'):
        load_case(write(wheel_angle=angle, motor_torque=torque))


@pytest.mark.parametrize('content', [
    b'', b'{', b'{"t": [0, 1}', b'[1, 2', b'mechanism: paper', b'\xff\xfe\x00', b'\x80abc'])
def test_file_that_is_not_json_is_refused(
    tmp_path: Path, content: bytes, refuses: Refuses,
) -> None:
    path = tmp_path / 'case.json'
    path.write_bytes(content)
    with refuses(CaseError, file=str(path)):
        load_case(path)


@pytest.mark.parametrize(('text', 'value'), [('[]', []), ('3', 3), ('"case"', 'case'),
                                             ('null', None)])
def test_file_without_an_object_is_refused(
    tmp_path: Path, text: str, value: Any, refuses: Refuses,
) -> None:
    path = tmp_path / 'case.json'
    path.write_text(text)
    with refuses(CaseError, place=str(path), value=value, limit=dict):
        load_case(path)


def test_missing_file_and_folder_are_refused(tmp_path: Path, refuses: Refuses) -> None:
    for path in (tmp_path / 'nowhere.json', tmp_path):
        with refuses(CaseError, file=str(path)):
            load_case(path)


def test_impossible_mechanism_is_refused_with_the_file(
    write: Callable[..., Path], refuses: Refuses,
) -> None:
    path = write()
    values = json.loads(path.read_text())
    values['mechanism']['link_masses'][2] = -1.0
    with refuses(CaseError, name='link_masses.link_c', value=-1.0):
        load_case(write(**values))


def test_motion_beyond_the_finite_numbers_is_refused(
    write: Callable[..., Path], refuses: Refuses,
) -> None:
    torque = {'amplitude': [1e200] * 4, 'frequency_hz': [0.0] * 4, 'phase': [0.0] * 4}
    case = load_case(write(motor_torque=torque))
    with refuses(CaseError, step=1e-3):
        simulate(case)


@pytest.mark.parametrize(('angles', 'rates', 'name'), [
    ([0.0, 1.0, 0.0, 2.0], NONE, 'link_angles'),
    ([0.0, 1.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0], 'link_rates'),
    ([0.0, 1.0, 0.0, 1.0], [0.0, 0.0, inf, 0.0], 'link_rates.link_c'),
    ([0.0, nan, 0.0, 1.0], NONE, 'link_angles.link_b'),
])
def test_impossible_states_are_refused(
    angles: Any, rates: Any, name: str, refuses: Refuses,
) -> None:
    case = Case(load_mechanism('paper'), np.array(angles), np.array(rates), NONE, NONE, NONE,
                NONE, np.array([0.0, 1.0]))
    with refuses(ClosureError, name=name):
        simulate(case)
