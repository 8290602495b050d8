# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The bags of known motions, for the tests of this folder."""

from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

from fourbar_ros.loop import load_scenario
import pytest
import yaml


@pytest.fixture(scope='session')
def synthetic():
    """Return the module that writes bags (tests are no package: it cannot be imported)."""
    spec = spec_from_file_location('synthetic', Path(__file__).with_name('synthetic.py'))
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='session')
def motion_bag(synthetic, tmp_path_factory):
    """Return the bag of the whole motion at 50 Hz."""
    return synthetic.write_bag(
        tmp_path_factory.mktemp('motion') / 'bag', synthetic.motion_messages())


@pytest.fixture(scope='session')
def loop_messages(synthetic):
    """Return what the nodes publish on a table with late and lossy sensors."""
    return synthetic.closed_loop_messages(replace(load_scenario('prototype'), duration=1.6))


@pytest.fixture(scope='session')
def loop_bag(synthetic, loop_messages, tmp_path_factory):
    """Return the bag of it."""
    return synthetic.write_bag(tmp_path_factory.mktemp('loop') / 'bag', loop_messages)


SHORT_RUNS = {
    'scenario': 'prototype', 'runs': 12, 'seed': 5, 'duration': 0.3,
    'set': {'arm_at': 0.05, 'setpoints[0].at': 0.08, 'setpoints[0].duration': 0.15,
            'setpoints[0].relative': {'link_a': 1e-3, 'link_b': 1e-3}},
    'vary': {
        'mechanism.flywheel_inertias': {'uniform': [0.9, 1.1], 'scale': True, 'each': True},
        'table.link_sensors.noise_rms': {'loguniform': [0.5, 2.0], 'scale': True},
        'controller.allocation': {'choice': ['bounded', 'min_norm']}},
}
"""A campaign of runs that take a moment."""


@pytest.fixture
def campaign_file(tmp_path):
    """Return a function that writes a campaign of short runs, with changes, and its path."""
    def write(name='short', **changes):
        values = {**SHORT_RUNS, **changes}
        path = tmp_path / f'{name}.yaml'
        path.write_text(yaml.safe_dump(
            {key: value for key, value in values.items() if value is not None},
            sort_keys=False))
        return str(path)
    return write
