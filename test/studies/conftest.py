# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Short campaigns for the tests of this folder."""

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
import signal
import time
from typing import Any

import pytest
import yaml

# Tests of campaigns need packages that a ROS installation does not bring.
collect_ignore = ([] if all(map(find_spec, ('distributed', 'loky', 'pyarrow'))) else [
    'test_montecarlo_cluster.py', 'test_montecarlo_folder.py', 'test_montecarlo_runs.py'])

# Longest wait for an event in another process [s]; the machine may be busy.
TIMEOUT = 300.0

# A campaign of short runs.
SHORT_RUNS = {
    'scenario': 'prototype', 'runs': 12, 'seed': 5, 'duration': 0.3,
    'set': {'arm_at': 0.05, 'setpoints[0].at': 0.08, 'setpoints[0].duration': 0.15,
            'setpoints[0].relative': {'link_a': 1e-3, 'link_b': 1e-3}},
    'vary': {
        'mechanism.flywheel_inertias': {'uniform': [0.9, 1.1], 'scale': True, 'each': True},
        'table.link_sensors.noise_rms': {'loguniform': [0.5, 2.0], 'scale': True},
        'controller.allocation': {'choice': ['bounded', 'min_norm']}},
}


@pytest.fixture
def campaign_file(tmp_path: Path) -> Callable[..., str]:
    """Return a function that writes a campaign of short runs with changes; returns its path."""
    def write(name: str = 'short', **changes: Any) -> str:
        values = {**SHORT_RUNS, **changes}
        path = tmp_path / f'{name}.yaml'
        path.write_text(yaml.safe_dump(
            {key: value for key, value in values.items() if value is not None},
            sort_keys=False))
        return str(path)
    return write


@pytest.fixture
def wait_until() -> Callable[[Callable[[], Any], str], None]:
    """Return a function that waits for a condition."""
    def wait(condition: Callable[[], Any], event: str) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, f'no {event} within {TIMEOUT} s'
            time.sleep(0.05)
    return wait


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Let SIGINT reach this process; a process in the background of a shell ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
