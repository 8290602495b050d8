# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of known motions for the tests of this folder."""

from dataclasses import replace

from fourbar_ros.loop import load_scenario
import pytest


@pytest.fixture(scope='session')
def motion_bag(synthetic, tmp_path_factory):
    """Return the bag of the whole motion at 50 Hz."""
    return synthetic.write_bag(
        tmp_path_factory.mktemp('motion') / 'bag', synthetic.motion_messages())


@pytest.fixture(scope='session')
def loop_messages(synthetic):
    """Return the messages of the nodes for a table with latency and dropout of sensors."""
    return synthetic.closed_loop_messages(replace(load_scenario('prototype'), duration=1.6))


@pytest.fixture(scope='session')
def loop_bag(synthetic, loop_messages, tmp_path_factory):
    """Return the bag of these messages."""
    return synthetic.write_bag(tmp_path_factory.mktemp('loop') / 'bag', loop_messages)
