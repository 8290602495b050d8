# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Case files, good and bad, prescribed wheels in them, and which branch a motion was on."""

from collections.abc import Callable
import json
from pathlib import Path
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism import ClosureError, load_mechanism, MechanismError
from fourbar_ros.mechanism.case import Case, CaseError, load_case, simulate
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
NONE = np.zeros(4)
REFERENCE = Path(__file__).parents[2] / 'config' / 'reference'
COSINE = {'amplitude': [10.0], 'frequency_hz': [0.5], 'phase': [0.0]}


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write a case of the paper's linkage, some of its keys replaced."""
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

def test_file_is_taken_as_it_is(write: Callable[..., Path]) -> None:
    torque = {'amplitude': [1e-5, 2e-5, 3e-5, 4e-5], 'frequency_hz': [0.1, 0.2, 0.3, 0.4],
              'phase': [1.0, 2.0, 3.0, 4.0]}
    initial = {'link_angles': [0.1, 1.0, 0.1, 1.0], 'link_rates': [0.2, 0.3, 0.2, 0.3],
               'flywheel_speeds_absolute': [5.0, 6.0, 7.0, 8.0]}
    case = load_case(write(initial=initial, motor_torque=torque, t=[1.0, 2.0, 2.5]))
    for name, value in {**torque, **initial, 'times': [1.0, 2.0, 2.5]}.items():
        np.testing.assert_array_equal(getattr(case, name), value, err_msg=name)
    np.testing.assert_array_equal(case.mechanism.link_masses, [0.02] * 4)
    assert not case.prescribed.any()


def test_rates_and_wheel_speeds_are_zero_unless_told(write: Callable[..., Path]) -> None:
    case = load_case(write())
    np.testing.assert_array_equal(case.link_rates, NONE)
    np.testing.assert_array_equal(case.flywheel_speeds_absolute, NONE)


def test_other_keys_are_left_alone(write: Callable[..., Path]) -> None:
    """A file may carry what it expects, and say what it is."""
    write_expected = write(note='from elsewhere', link_angles=[[0.0] * 4] * 3)
    assert load_case(write_expected).times.size == 3


@pytest.mark.parametrize('path', sorted(REFERENCE.glob('*.json')), ids=lambda path: path.stem)
def test_reference_motions_can_be_read(path: Path) -> None:
    assert load_case(path).times[0] == 0.0


def test_wheel_angle_in_a_file_moves_the_wheel(write: Callable[..., Path]) -> None:
    angle = {'flywheels': ['flywheel_b'], **COSINE}
    motion = simulate(load_case(write(wheel_angle=angle)))
    # 10 cos(pi t), up to a constant.
    np.testing.assert_allclose(
        motion.flywheel_angles[:, 1], [0.0, -10.0, -20.0], rtol=0.0, atol=1e-9)
    # A wheel that nobody turns keeps its direction in the table frame.
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


def test_prescribed_wheel_starts_as_its_law_has_it(write: Callable[..., Path]) -> None:
    """Not as the initial state has it: at the first time, 0.25 s, the law is at full speed."""
    initial = {'link_angles': [0.0, 1.0, 0.0, 1.0], 'link_rates': [0.3, 0.0, 0.3, 0.0],
               'flywheel_speeds_absolute': [77.0] * 4}
    angle = {'flywheels': ['flywheel_a'], 'amplitude': [10.0], 'frequency_hz': [1.0],
             'phase': [0.0]}
    motion = simulate(load_case(write(initial=initial, wheel_angle=angle, t=[0.25, 0.5])))
    assert motion.flywheel_speeds_absolute[0, 0] == pytest.approx(0.3 - 20.0 * np.pi, rel=1e-14)
    np.testing.assert_array_equal(motion.flywheel_speeds_absolute[0, 1:], [77.0] * 3)
    # 10 cos(pi) - 10 cos(pi / 2); Simpson's rule leaves 1e-12 of it.
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

@pytest.mark.parametrize(('changes', 'message'), [
    ({'wheel_angle': {'flywheels': ['flywheel_x'], **COSINE}},
     "wheel_angle: no flywheel 'flywheel_x' (known are flywheel_a, flywheel_b, flywheel_c, "
     'flywheel_d)'),
    ({'wheel_angle': {'flywheels': ['link_a'], **COSINE}}, "no flywheel 'link_a'"),
    ({'wheel_angle': {'flywheels': [0], **COSINE}}, 'no flywheel 0'),
    ({'wheel_angle': {'flywheels': [['flywheel_a']], **COSINE}}, "no flywheel ['flywheel_a']"),
    ({'wheel_angle': {'flywheels': ['flywheel_a'] * 2, **COSINE}},
     "wheel_angle needs flywheels, a list of different names, got ['flywheel_a', 'flywheel_a']"),
    ({'wheel_angle': {'flywheels': [], **COSINE}}, 'a list of different names, got []'),
    ({'wheel_angle': {'flywheels': 'flywheel_a', **COSINE}}, "names, got 'flywheel_a'"),
    ({'wheel_angle': COSINE}, 'a list of different names, got None'),
    ({'wheel_angle': ['flywheel_a']}, 'wheel_angle is missing or is not an object'),
    ({'wheel_angle': {'flywheels': ['flywheel_a', 'flywheel_b'], **COSINE}},
     'amplitude must be 2 numbers, got shape (1,)'),
    ({'wheel_angle': {'flywheels': ['flywheel_a'], **COSINE, 'phase': 1.0}},
     'phase must be 1 number, got shape ()'),
    ({'wheel_angle': {'flywheels': ['flywheel_a'], **COSINE, 'frequency_hz': [float('inf')]}},
     'frequency_hz must be finite, got inf'),
    ({'wheel_angle': {'flywheels': ['flywheel_a'], 'amplitude': [1.0], 'phase': [0.0]}},
     'frequency_hz is missing'),
    ({'wheel_angle': {'flywheels': ['flywheel_c', 'flywheel_a'], 'amplitude': [1.0, 1.0],
                      'frequency_hz': [1.0, 1.0], 'phase': [0.0, 0.0]}, 'motor_torque': {
        'amplitude': [1.0, 0.0, 0.0, 0.0], 'frequency_hz': [1.0] * 4, 'phase': [0.0] * 4}},
     'flywheel_a has a prescribed angle and a motor torque: only one of the two can be given'),
    ({'motor_torque': None}, 'motor_torque is missing or is not an object'),
    ({'motor_torque': None, 'wheel_angle': {'flywheels': ['flywheel_a'], **COSINE}},
     'motor_torque is missing or is not an object'),
    ({'motor_torque': {'amplitude': [1.0] * 3, 'frequency_hz': [1.0] * 4, 'phase': [0.0] * 4}},
     'amplitude must be 4 numbers, in the order link_a, link_b, link_c, link_d, got shape (3,)'),
    ({'motor_torque': {'amplitude': ['1'] * 4, 'frequency_hz': [1.0] * 4, 'phase': [0.0] * 4}},
     "amplitude must hold numbers, got ['1', '1', '1', '1']"),
    ({'motor_torque': {'amplitude': [True] * 4, 'frequency_hz': [1.0] * 4, 'phase': [0.0] * 4}},
     'amplitude must hold numbers, got [True, True, True, True]'),
    ({'initial': None}, 'initial is missing or is not an object'),
    ({'initial': {}}, 'link_angles is missing'),
    ({'initial': {'link_angles': [0.0, 1.0, 0.1, 1.0]}},
     'initial: the link angles do not close the loop: gap 0.01 m, limit 1e-07 m'),
    ({'initial': {'link_angles': [0.0, 1.0, 0.0, 1.0], 'link_rates': [0.0, 1.0, 0.0, 0.0]}},
     'initial: the link rates do not keep the loop closed: joint 3 would open at 0.1 m/s, limit '
     '1e-07 m/s'),
    ({'initial': {'link_angles': [0.0, 1.0, 0.0, float('nan')]}},
     'link_angles must be finite, got nan'),
    ({'initial': {'link_angles': [0.0, 1.0, 0.0, 1.0],
                  'flywheel_speeds_absolute': [0.0] * 5}},
     'flywheel_speeds_absolute must be 4 numbers'),
    ({'t': None}, 't is missing'),
    ({'t': [0.0]}, 't must hold at least two increasing times'),
    ({'t': []}, 't must hold'),
    ({'t': [0.0, 1.0, 1.0]}, 't must hold at least two increasing times'),
    ({'t': [[0.0], [1.0]]}, 't must be a list, got shape (2, 1)'),
    ({'t': [0.0, float('inf')]}, 't must be finite, got inf'),
    ({'mechanism': 'paper'}, 'mechanism is missing or is not an object'),
])
def test_bad_files_are_refused(
    changes: dict[str, Any], message: str, write: Callable[..., Path],
) -> None:
    """In one line that names the file and what is wrong in it."""
    path = write(**changes)
    with pytest.raises(CaseError) as refusal:
        load_case(path)
    assert message in str(refusal.value)
    assert str(refusal.value).startswith(f'{path}: ')
    assert '\n' not in str(refusal.value)


def test_torque_on_one_of_four_prescribed_wheels_is_refused(write: Callable[..., Path]) -> None:
    """As it is with three."""
    cosine = {name: value * 4 for name, value in COSINE.items()}
    angle = {'flywheels': [f'flywheel_{letter}' for letter in 'abcd'], **cosine}
    torque = {**cosine, 'amplitude': [0.0, 1.0, 0.0, 0.0]}
    with pytest.raises(CaseError, match='flywheel_b has a prescribed angle and a motor torque'):
        load_case(write(wheel_angle=angle, motor_torque=torque))


@pytest.mark.parametrize('text', ['', '{', '{"t": [0, 1}', '[1, 2', 'mechanism: paper'])
def test_what_is_no_json_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / 'case.json'
    path.write_text(text)
    with pytest.raises(CaseError, match=r'case\.json is not JSON, or is cut: '):
        load_case(path)


@pytest.mark.parametrize('content', [b'\xff\xfe\x00', b'\x80abc'])
def test_what_is_no_text_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'case.json'
    path.write_bytes(content)
    with pytest.raises(CaseError, match=r'case\.json is not JSON'):
        load_case(path)


@pytest.mark.parametrize('text', ['[]', '3', '"case"', 'null'])
def test_what_is_no_object_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / 'case.json'
    path.write_text(text)
    with pytest.raises(CaseError, match=r'case\.json: must hold a JSON object'):
        load_case(path)


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaseError, match=r'cannot read .*nowhere\.json: No such file'):
        load_case(tmp_path / 'nowhere.json')


def test_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaseError, match='cannot read .*: Is a directory'):
        load_case(tmp_path)


def test_impossible_mechanism_is_refused_with_the_file(write: Callable[..., Path]) -> None:
    path = write()
    values = json.loads(path.read_text())
    values['mechanism']['link_masses'][2] = -1.0
    with pytest.raises(MechanismError) as refusal:
        load_case(write(**values))
    assert str(refusal.value) == (
        f'{path}, mechanism: link_masses of link_c must be positive, got -1')


@pytest.mark.parametrize('error', [CaseError, ClosureError, MechanismError])
def test_errors_are_those_of_the_package(error: type[Exception]) -> None:
    assert issubclass(error, FourbarError)


def test_motion_beyond_the_finite_numbers_is_refused(write: Callable[..., Path]) -> None:
    torque = {'amplitude': [1e200] * 4, 'frequency_hz': [0.0] * 4, 'phase': [0.0] * 4}
    case = load_case(write(motor_torque=torque))
    with pytest.raises(CaseError, match='the motion is no longer finite at t = 0.5 s: torques '
                                        'too large for a step of 0.001 s'):
        simulate(case)


@pytest.mark.parametrize(('angles', 'rates', 'message'), [
    ([0.0, 1.0, 0.0, 2.0], NONE, 'gap 0.0959 m, limit 1e-07 m'),
    ([0.0, 1.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0], 'open at 0.1 m/s, limit 1e-07 m/s'),
    ([0.0, 1.0, 0.0, 1.0], [0.0, 0.0, np.inf, 0.0], 'rate of link_c must be finite, got inf'),
    ([0.0, np.nan, 0.0, 1.0], NONE, 'angle of link_b must be finite, got nan'),
])
def test_states_that_cannot_be_are_refused(angles: Any, rates: Any, message: str) -> None:
    case = Case(load_mechanism('paper'), np.array(angles), np.array(rates), NONE, NONE, NONE,
                NONE, np.array([0.0, 1.0]))
    with pytest.raises(ClosureError, match=message):
        simulate(case)


def test_motion_tells_its_branches() -> None:
    """Pairs that turn apart from a fold leave the change point on the folded branch."""
    case = Case(load_mechanism('paper'), NONE, np.array([1.0, 1.0, -1.0, -1.0]), NONE, NONE, NONE,
                NONE, np.linspace(0.0, 1.0, 5))
    assert simulate(case).branches() == [(0.0, 'open'), (0.25, 'folded')]
