# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures of calibrations are drawn, and the same data give the same bytes."""

from collections.abc import Callable
from typing import Any

from fourbar_ros.analysis.calibration.calibration_figures import links_figure, wheels_figure
from fourbar_ros.analysis.calibration.excitation import MultiSine, SpinAndCoast
from fourbar_ros.analysis.calibration.link_identification import link_estimate
from fourbar_ros.analysis.calibration.wheel_identification import wheel_estimate
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.plant import Table
from fourbar_ros.plotting.style import render
import pytest


@pytest.mark.slow
def test_wheels_are_drawn(prototype: Mechanism, lab: Table, excited: Callable[..., Any]) -> None:
    signals = excited(prototype, lab, SpinAndCoast(prototype, [0], 60.0, 0.02, 3.0), 0)
    estimates = [wheel_estimate(0, *signals)]
    first, second = (render(lambda: wheels_figure(estimates), 'svg') for _ in range(2))
    assert first == second
    assert b'flywheel_a' in first and b'flywheel_b' not in first
    assert render(lambda: wheels_figure(estimates), 'png').startswith(b'\x89PNG')


@pytest.mark.slow
def test_links_are_drawn(prototype: Mechanism, lab: Table, excited: Callable[..., Any]) -> None:
    estimate = link_estimate(
        prototype, *excited(prototype, lab, MultiSine(prototype, 12.0, 0.02), 0))
    picture = render(lambda: links_figure(estimate), 'svg')
    assert all(name in picture for name in (b'link_a', b'link_b', b'link_c', b'link_d'))
