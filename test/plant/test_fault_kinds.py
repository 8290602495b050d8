# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Kinds of faults, their text form, and the parameters of faulty wheel drives."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import FrozenInstanceError
from math import inf, nan, pi

from fourbar_ros.mechanism import FLYWHEEL_NAMES, JOINT_NAMES, LINK_NAMES, SENSOR_NAMES
from fourbar_ros.plant.faults import (
    Fault,
    fault_kinds,
    FaultError,
    FaultKind,
    parse_fault,
    SENSOR_FAULTS,
    WHEEL_FAULTS,
    wheel_faults,
    WheelFaults,
)
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

Refuses = Callable[..., AbstractContextManager[None]]
HEALTHY_WHEELS = wheel_faults(())
TARGETS = (*SENSOR_NAMES, *FLYWHEEL_NAMES)
ALL = [(target, kind) for target in TARGETS for kind in fault_kinds(target)]
WITH_VALUE = [(target, kind) for target in ('link_b', 'joint_3', 'flywheel_d')
              for kind, what in fault_kinds(target).items() if what.quantity]
WITHOUT_VALUE = [(target, kind) for target in ('link_b', 'joint_3', 'flywheel_d')
                 for kind, what in fault_kinds(target).items() if not what.quantity]
ARRAYS = ('torque_scale', 'extra_friction', 'forced_torque', 'shorted_torque', 'hold_torque',
          'command_delay_s')


def as_numbers(faults: WheelFaults) -> np.ndarray:
    """Return all six arrays (6, 4), NaN written as 99."""
    return np.nan_to_num(np.array([getattr(faults, name) for name in ARRAYS]), nan=99.0)


def test_documented_faults_exist() -> None:
    assert set(SENSOR_FAULTS) == {
        'off', 'stuck', 'garbage', 'wrong', 'slow', 'delayed', 'intermittent'}
    assert set(WHEEL_FAULTS) == {
        'dead', 'stuck', 'weak', 'dragging', 'runaway', 'shorted', 'delayed'}
    assert {target for target, _ in ALL} == {*LINK_NAMES, *JOINT_NAMES, *FLYWHEEL_NAMES}


@pytest.mark.parametrize(('target', 'kind'), ALL)
def test_every_fault_is_written_and_read(target: str, kind: str) -> None:
    fault = parse_fault(target, kind)
    assert fault == Fault(target, kind)
    assert parse_fault(target, str(fault)) == fault


@pytest.mark.medium
@settings(deadline=None, derandomize=True)
@given(value=st.floats(-pi, pi))
def test_a_value_survives_writing(value: float) -> None:
    fault = Fault('link_c', 'wrong', value)
    assert parse_fault('link_c', str(fault)) == fault


@pytest.mark.parametrize('text', ['', '  ', 'none', ' none '])
def test_none_is_no_fault(text: str) -> None:
    assert parse_fault('flywheel_a', text) is None


@pytest.mark.parametrize(('target', 'kind'), WITH_VALUE)
def test_default_value_has_an_effect(target: str, kind: str) -> None:
    what = fault_kinds(target)[kind]
    healthy = 1.0 if kind == 'weak' else 0.0
    assert Fault(target, kind).value == what.default != healthy


@pytest.mark.parametrize(('target', 'kind'), WITH_VALUE)
def test_ends_of_the_range_are_accepted(target: str, kind: str) -> None:
    what = fault_kinds(target)[kind]
    for value in (what.low, what.high):
        assert Fault(target, kind, value).value == value


@pytest.mark.parametrize(('target', 'kind'), WITH_VALUE)
def test_value_beyond_the_range_is_refused(target: str, kind: str, refuses: Refuses) -> None:
    what = fault_kinds(target)[kind]
    for value in (np.nextafter(what.low, -inf), np.nextafter(what.high, inf), nan, inf, -inf):
        with refuses(FaultError, name=f'{target}.{kind}', limit=(what.low, what.high)):
            Fault(target, kind, float(value))


@pytest.mark.parametrize('value', ['1', True, [0.1], {}])
def test_value_that_is_no_number_is_refused(value: object, refuses: Refuses) -> None:
    with refuses(FaultError, name='link_a.wrong', value=value, limit=float):
        Fault('link_a', 'wrong', value)  # type: ignore[arg-type]


@pytest.mark.parametrize(('target', 'kind'), WITHOUT_VALUE)
def test_value_of_a_fault_without_one_is_refused(
    target: str, kind: str, refuses: Refuses,
) -> None:
    with refuses(FaultError, name=f'{target}.{kind}', value=0.5, limit=None):
        parse_fault(target, f'{kind} 0.5')


@pytest.mark.parametrize('probability', ['-0.1', '1.1', 'nan'])
def test_probability_outside_0_to_1_is_refused(probability: str, refuses: Refuses) -> None:
    with refuses(FaultError, name='joint_2.intermittent', limit=(0.0, 1.0)):
        parse_fault('joint_2', f'intermittent {probability}')


@pytest.mark.parametrize(('target', 'kind', 'known'), [
    ('link_b', 'dead', SENSOR_FAULTS), ('flywheel_b', 'off', WHEEL_FAULTS)])
def test_unknown_kind_is_refused_with_those_known(
    target: str, kind: str, known: dict[str, FaultKind], refuses: Refuses,
) -> None:
    with refuses(FaultError, name=target, value=kind, limit=tuple(known)):
        parse_fault(target, kind)


@pytest.mark.parametrize('text', ['', 'none', 'stuck'])
def test_unknown_target_is_refused_with_those_known(text: str, refuses: Refuses) -> None:
    known = (*SENSOR_NAMES, *FLYWHEEL_NAMES)
    with refuses(FaultError, name='target', value='link_e', limit=known):
        parse_fault('link_e', text)


@pytest.mark.parametrize('text', ['wrong 0.1 rad', 'none none none'])
def test_too_many_words_are_refused(text: str, refuses: Refuses) -> None:
    with refuses(FaultError, name='link_a', value=text):
        parse_fault('link_a', text)


def test_value_that_is_a_word_is_refused(refuses: Refuses) -> None:
    with refuses(FaultError, name='link_a.wrong', value='0.1rad', limit=float):
        parse_fault('link_a', 'wrong 0.1rad')


def test_a_fault_cannot_be_made_invalid_later() -> None:
    with pytest.raises(FrozenInstanceError):
        Fault('link_a', 'wrong').value = nan  # type: ignore[misc]


@pytest.mark.parametrize(('text', 'array', 'value'), [
    ('dead', 'torque_scale', 0.0),
    ('weak 0.3', 'torque_scale', 0.3),
    ('weak 0', 'torque_scale', 0.0),
    ('dragging 2e-4', 'extra_friction', 2e-4),
    ('runaway -0.02', 'forced_torque', -0.02),
    ('runaway 0', 'forced_torque', 0.0),
    ('shorted 0.03', 'shorted_torque', 0.03),
    ('shorted 0', 'shorted_torque', 0.0),
    ('stuck 0.07', 'hold_torque', 0.07),
    ('delayed 0.04', 'command_delay_s', 0.04),
])
@pytest.mark.parametrize('wheel', range(4))
def test_a_fault_changes_one_number_of_one_wheel(
    text: str, array: str, value: float, wheel: int,
) -> None:
    fault = parse_fault(FLYWHEEL_NAMES[wheel], text)
    assert fault is not None
    expected = as_numbers(HEALTHY_WHEELS)
    expected[ARRAYS.index(array), wheel] = value
    np.testing.assert_array_equal(as_numbers(wheel_faults([fault])), expected)


def test_healthy_wheels_follow_their_commands() -> None:
    assert HEALTHY_WHEELS.torque_scale.tolist() == [1.0] * 4
    assert np.isnan(HEALTHY_WHEELS.forced_torque).all()
    assert np.isnan(HEALTHY_WHEELS.shorted_torque).all()
    for name in ('extra_friction', 'hold_torque', 'command_delay_s'):
        assert not getattr(HEALTHY_WHEELS, name).any()


def test_every_wheel_has_its_own_fault() -> None:
    faults = wheel_faults(
        [Fault('flywheel_d', 'dead'), Fault('flywheel_a', 'weak', 0.2), Fault('link_b', 'stuck')])
    assert faults.torque_scale.tolist() == [0.2, 1.0, 1.0, 0.0]
    assert not faults.hold_torque.any()


@pytest.mark.parametrize('name', ARRAYS)
def test_wheel_numbers_cannot_be_written_to(name: str) -> None:
    with pytest.raises(ValueError):
        getattr(wheel_faults([Fault('flywheel_a', 'dead')]), name)[0] = 1.0
