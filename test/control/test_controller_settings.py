# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The table of parameters agrees with the settings."""

from __future__ import annotations

from dataclasses import fields

from fourbar_ros.common.settings import Setting
from fourbar_ros.control import Controller, ControllerSettings
from fourbar_ros.control.settings import PARAMETERS, SETTINGS, WHEEL_TARGETS
from fourbar_ros.mechanism import Mechanism
import pytest

each_row = pytest.mark.parametrize('row', SETTINGS, ids=[row.name for row in SETTINGS])


def test_rows_are_the_fields_of_the_settings_in_order() -> None:
    assert [row.name for row in SETTINGS] == [field.name for field in fields(ControllerSettings)]
    assert [row.name for row in PARAMETERS] == ['mechanism', *(row.name for row in SETTINGS)]


@each_row
def test_defaults_are_those_of_the_settings_and_are_valid(row: Setting) -> None:
    assert row.default == getattr(ControllerSettings(), row.name)
    assert (row.limits is None) != (row.choices is None)
    if row.limits is not None:
        assert row.limits[0] <= row.default <= row.limits[1]
    else:
        assert row.choices is not None
        assert row.default in row.choices


@each_row
def test_every_parameter_can_be_set_at_run_time_and_is_described(row: Setting) -> None:
    assert row.live
    assert row.meaning
    assert not row.meaning.endswith('.')


@pytest.mark.parametrize(('row', 'choice'), [
    (row, choice) for row in SETTINGS for choice in row.choices or ()],
    ids=[f'{row.name}-{choice}' for row in SETTINGS for choice in row.choices or ()])
def test_controller_accepts_every_choice(
    row: Setting, choice: str, prototype: Mechanism,
) -> None:
    controller = Controller(prototype, ControllerSettings())
    controller.tune(ControllerSettings(**{row.name: choice}))  # type: ignore[arg-type]
    assert getattr(controller.settings, row.name) == choice


def test_null_space_target_may_be_free() -> None:
    assert WHEEL_TARGETS[0] == ControllerSettings().wheel_target == 'free'
