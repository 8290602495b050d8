# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The estimator imports filterpy's extended Kalman filter without plotting libraries."""

import subprocess
import sys

import pytest

# Modules that filterpy imports and the filter does not need.
HEAVY = ('matplotlib', 'scipy.stats', 'scipy.optimize', 'scipy.ndimage')


def run(code: str) -> list[str]:
    """Run code in a new interpreter, and return the words that it prints."""
    return subprocess.run(
        [sys.executable, '-P', '-c', code], capture_output=True, text=True, check=True
    ).stdout.split()


@pytest.mark.medium
def test_import_of_the_estimator_loads_no_plotting_and_no_statistics() -> None:
    loaded = run('import fourbar_ros.estimation, sys; print(*sys.modules)')
    assert 'filterpy.kalman.EKF' in loaded
    assert set(HEAVY).isdisjoint(loaded)


@pytest.mark.slow
def test_later_import_of_filterpy_is_complete() -> None:
    """Before and after, it is the real package, and its filter is the same class."""
    after = run(
        'from fourbar_ros.estimation.filterpy_ekf import ExtendedKalmanFilter as ours\n'
        'import filterpy.kalman, filterpy.stats\n'
        'print(filterpy.kalman.ExtendedKalmanFilter is ours, filterpy.__version__,'
        ' callable(filterpy.kalman.KalmanFilter), callable(filterpy.stats.gaussian))')
    before = run(
        'import filterpy.kalman, filterpy.stats\n'
        'from fourbar_ros.estimation.filterpy_ekf import ExtendedKalmanFilter as ours\n'
        'print(filterpy.kalman.ExtendedKalmanFilter is ours, filterpy.__version__,'
        ' callable(filterpy.kalman.KalmanFilter), callable(filterpy.stats.gaussian))')
    assert after == before
    assert after[0] == after[2] == after[3] == 'True'


@pytest.mark.slow
def test_log_likelihood_is_that_of_filterpy() -> None:
    """The density behind it is imported on first use."""
    code = (
        'import numpy as np\n'
        'from {} import ExtendedKalmanFilter\n'
        'f = ExtendedKalmanFilter(2, 1)\n'
        'f.x, f.y, f.S = np.zeros(2), np.array([0.3]), np.array([[2.0]])\n'
        'f._log_likelihood = None\n'
        'print(f.log_likelihood)')
    assert run(code.format('fourbar_ros.estimation.filterpy_ekf')) == run(
        code.format('filterpy.kalman'))
