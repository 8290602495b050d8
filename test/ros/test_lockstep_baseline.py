# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A recorded lock-step run has the topics and the metrics of the first edition."""

import json
from math import isclose
from pathlib import Path
import signal

from fourbar_ros.cli.main import main
import pytest
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

pytestmark = [pytest.mark.node, pytest.mark.slow]

BASELINE = Path(__file__).parents[1] / 'data' / 'baseline'
NODES = {
    'plant': {'clock': 'lockstep', 'start_paused': True, 'seed': 3},
    'estimator': {},
    'controller': {'setpoint_duration': 3.0},
}
# Ticks before arming, between arming and setpoint, and after the setpoint, as in the baseline.
BEFORE, BETWEEN, AFTER = 40, 10, 1300
# Relative tolerance for a changed order of arithmetic.
TOLERANCE = 1e-9


@pytest.fixture(scope='module')
def bag(module_suite, make_probe, tmp_path_factory):
    """Record a lock-step run tick by tick, and return the bag."""
    probe = make_probe()
    for name, parameters in NODES.items():
        module_suite.node(name, {**parameters, 'use_sim_time': True})
    bag = tmp_path_factory.mktemp('lockstep') / 'bag'
    recorder = module_suite.start('record', '-o', str(bag))
    publisher = probe.publisher(JointState, 'setpoint')
    # Controller and recorder subscribe to the setpoint.
    probe.wait(lambda: publisher.get_subscription_count() >= 2)
    client = probe.node.create_client(Trigger, 'sim/step')
    probe.wait(client.service_is_ready)

    def stepped():
        future = client.call_async(Trigger.Request())
        probe.wait(future.done)
        return future.result().success

    def step(count):
        for _ in range(count):
            probe.wait(stepped)
    step(BEFORE)
    probe.wait(lambda: probe.arm().success)
    step(BETWEEN)
    probe.setpoint_decision(
        JointState(name=['link_a', 'link_b'], position=[0.3, 1.5]), publisher)
    step(AFTER)
    recorder.end(signal.SIGINT)
    return bag


def flat(document, place=''):
    """Return the leaves of a JSON document by their path."""
    if isinstance(document, dict):
        return {key: value for name, entry in document.items()
                for key, value in flat(entry, f'{place}.{name}').items()}
    return {place: document}


def test_metrics_are_those_of_the_first_edition(bag, tmp_path):
    metrics = tmp_path / 'metrics.json'
    assert main(['report', str(bag), '-o', str(tmp_path / 'report.html'),
                 '--metrics', str(metrics)]) == 0
    before, after = (flat(json.loads(path.read_text()))
                     for path in (BASELINE / 'lockstep_metrics.json', metrics))
    assert after.keys() == before.keys()
    different = {
        place: (value, after[place]) for place, value in before.items()
        if not (isclose(value, after[place], rel_tol=TOLERANCE) if isinstance(value, float)
                else value == after[place])}
    assert different == {}


def test_topics_are_those_of_the_first_edition(bag):
    """Compare names, types, serialization, and the offered durability and reliability."""
    with Reader(bag) as reader:
        found = {connection.topic: connection for connection in reader.connections}
    for expected in json.loads((BASELINE / 'demo_connections.json').read_text()):
        connection = found[expected['topic']]
        assert (connection.msgtype, connection.digest) == (expected['type'], expected['digest'])
        assert connection.ext.serialization_format == expected['format']
        # One profile for each publisher that the recorder had discovered at the first message.
        profiles = {str(profile) for profile in connection.ext.offered_qos_profiles}
        assert profiles == set(expected['qos']), expected['topic']
