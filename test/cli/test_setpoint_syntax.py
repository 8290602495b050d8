# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The arguments of `fourbar setpoint link_a=0 link_b=90deg`."""

from math import pi, radians

from fourbar_ros.cli.setpoint import parse_goal, SetpointSyntaxError
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest


@pytest.mark.parametrize(('text', 'name', 'angle'), [
    ('link_a=0', 'link_a', 0.0),
    ('link_b=90deg', 'link_b', pi / 2),
    ('link_b=-90deg', 'link_b', -pi / 2),
    ('link_c=1.57', 'link_c', 1.57),
    ('link_c=1.57rad', 'link_c', 1.57),
    ('link_d=-.5', 'link_d', -0.5),
    ('link_d=1e-3', 'link_d', 1e-3),
    ('link_d=450deg', 'link_d', 2.5 * pi),
    ('anything=1', 'anything', 1.0),
])
def test_angles_are_in_radians_unless_they_have_the_unit_deg(
    text: str, name: str, angle: float,
) -> None:
    assert parse_goal(text) == (name, pytest.approx(angle, rel=1e-15))


@pytest.mark.parametrize('text', [
    '', '=', 'link_a', 'link_a=', '=1', 'link_a=deg', 'link_a=rad', 'link_a=one', 'link_a=1=2',
    'link_a=1grad', 'link_a=1degdeg', 'link_a=nan', 'link_a=inf', 'link_a=-infdeg', 'link_a=1e999',
    'link_a 1', 'link_a=1,5', 'link_a:1'])
def test_bad_syntax_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(SetpointSyntaxError) as caught:
        parse_goal(text)
    assert caught.value.values == {'value': text}
    assert 'link_a=30deg' in str(caught.value)


@pytest.mark.medium
@settings(derandomize=True)
@given(angle=st.floats(allow_nan=False, allow_infinity=False))
def test_every_number_is_read_back_from_its_text(angle: float) -> None:
    assert parse_goal(f'link_a={angle!r}') == ('link_a', angle)
    assert parse_goal(f'link_a={angle!r}deg') == ('link_a', radians(angle))
