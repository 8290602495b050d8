# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A wheel command is accepted or rejected as a whole."""

from itertools import permutations
from math import inf, nan

from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.device.command import drive_by_name
from fourbar_ros.mechanism import FLYWHEEL_NAMES
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

A, B, C, D = FLYWHEEL_NAMES
finite = st.floats(allow_nan=False, allow_infinity=False)


def rejected(names: list[str], efforts: list[float], **others: list[float]) -> RejectedError:
    with pytest.raises(RejectedError) as caught:
        drive_by_name(
            names, others.get('positions', []), others.get('velocities', []), efforts)
    return caught.value


@pytest.mark.parametrize('order', list(permutations(range(4))))
def test_names_may_come_in_any_order(order: tuple[int, ...]) -> None:
    names, values = [FLYWHEEL_NAMES[wheel] for wheel in order], [10.0 + wheel for wheel in order]
    for drive, by_speed in ((drive_by_name(names, [], [], values), False),
                            (drive_by_name(names, [], values, []), True)):
        assert drive.values.tolist() == [10.0, 11.0, 12.0, 13.0]
        assert drive.by_speed.tolist() == [by_speed] * 4
        assert drive.powered.all()


@settings(derandomize=True)
@given(given_torques=st.dictionaries(st.sampled_from(FLYWHEEL_NAMES), finite, min_size=1))
def test_wheel_missing_in_a_command_has_no_power(given_torques: dict[str, float]) -> None:
    drive = drive_by_name(list(given_torques), [], [], list(given_torques.values()))
    assert drive.values.tolist() == [given_torques.get(name, 0.0) for name in FLYWHEEL_NAMES]
    assert not drive.by_speed.any()
    assert drive.powered.tolist() == [name in given_torques for name in FLYWHEEL_NAMES]


@settings(derandomize=True)
@given(speeds=st.dictionaries(st.sampled_from(FLYWHEEL_NAMES), finite, min_size=1))
def test_wheel_missing_in_a_speed_command_coasts(speeds: dict[str, float]) -> None:
    drive = drive_by_name(list(speeds), [], list(speeds.values()), [])
    assert drive.values.tolist() == [speeds.get(name, 0.0) for name in FLYWHEEL_NAMES]
    assert drive.by_speed.tolist() == [name in speeds for name in FLYWHEEL_NAMES]
    assert drive.powered.tolist() == [name in speeds for name in FLYWHEEL_NAMES]


@pytest.mark.parametrize('name', ['flywheel_e', 'link_a', '', 'Flywheel_a'])
def test_unknown_wheel_is_named(name: str) -> None:
    error = rejected([A, name], [1.0, 1.0])
    assert error.kind == 'names'
    assert repr(name) in str(error)


@pytest.mark.parametrize('names', [[A, A], [A, B, C, B]])
def test_repeated_wheel_is_named(names: list[str]) -> None:
    error = rejected(names, [1.0] * len(names))
    assert error.kind == 'names'
    assert names[-1] in str(error)


@pytest.mark.parametrize(('names', 'efforts'), [
    ([], []), ([], [1.0]), ([A], []), ([A, B], [1.0]), ([A], [1.0, 2.0])])
def test_lengths_must_agree(names: list[str], efforts: list[float]) -> None:
    error = rejected(names, efforts)
    assert error.kind == 'length'
    if names:
        assert f'{len(names)} names but {len(efforts)}' in str(error)


@pytest.mark.parametrize('value', [nan, inf, -inf])
@pytest.mark.parametrize('wheel', FLYWHEEL_NAMES)
def test_effort_must_be_finite(wheel: str, value: float) -> None:
    error = rejected(list(FLYWHEEL_NAMES), [value if name == wheel else 0.0
                                            for name in FLYWHEEL_NAMES])
    assert error.kind == 'finite'
    assert wheel in str(error)
    assert str(value) in str(error)


@pytest.mark.parametrize(('efforts', 'others'), [
    ([1.0], {'positions': [0.0]}), ([], {'positions': [0.0]}), ([1.0], {'velocities': [0.0]}),
    ([], {'positions': [0.0], 'velocities': [0.0]})])
def test_command_has_either_effort_or_velocity(
    efforts: list[float], others: dict[str, list[float]],
) -> None:
    assert rejected([A], efforts, **others).kind == 'fields'
