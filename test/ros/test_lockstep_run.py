# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A lock-step run over real topics and the loop without ROS give the same numbers."""

from dataclasses import replace

from fourbar_ros.loop import load_scenario, make_loop, RunRecord
import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

pytestmark = pytest.mark.node

# Ticks before arming, between arming and setpoint, and after the setpoint.
BEFORE, BETWEEN, AFTER = 40, 10, 300
COMMANDS = {'paper': 'effort', 'prototype': 'velocity'}
GOAL = {'link_a': 0.3, 'link_b': 1.5}
TOPICS = {
    'link_angles': ('position',), 'flywheel_states': ('position', 'velocity', 'effort'),
    'sim/link_states': ('position', 'velocity'),
    'sim/flywheel_states': ('position', 'velocity', 'effort'),
    'estimate/link_states': ('position', 'velocity', 'effort'),
    'estimate/sigma': ('position', 'velocity'),
    'reference': ('position', 'velocity'), 'tracking_error': ('position', 'velocity'),
    'flywheel_command': ('effort', 'velocity'), 'energy': ('position',)}


def stamp_of(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def without_ros(scenario):
    """Run the sequence in one process; return arrays by topic and field."""
    loop = make_loop(scenario)
    recording = RunRecord(scenario.table.link_sensors.sensor_names)
    for tick in range(BEFORE + BETWEEN + AFTER):
        if tick == BEFORE:
            assert loop.arm()[0]
        if tick == BEFORE + BETWEEN:
            loop.controller.setpoint(list(GOAL), list(GOAL.values()))
        recording.add(loop.step())
    return recording.arrays()


def over_topics(scenario, suite, probe, namespace):
    """Run the sequence with three nodes, paused at each request; return messages by topic."""
    parameters = scenario.parameters()
    for name in ('plant', 'estimator', 'controller'):
        extra = {'clock': 'lockstep', 'start_paused': True} if name == 'plant' else {}
        suite.node(name, {**parameters[name], **extra, 'use_sim_time': True}, namespace)
    probe.follow(*TOPICS)
    publisher = probe.publisher(JointState, 'setpoint')
    ticks = probe.received['flywheel_states']

    client = probe.node.create_client(Trigger, 'sim/step')
    probe.wait(client.service_is_ready)

    def stepped():
        """Request a tick; the plant refuses it until the last one is answered."""
        future = client.call_async(Trigger.Request())
        probe.wait(future.done)
        return future.result().success

    def step(count):
        for _ in range(count):
            probe.wait(stepped)
    step(BEFORE)
    assert probe.arm().success
    probe.status('device_status', state='armed')
    step(BETWEEN)
    probe.status('controller_status', mode='hold')
    probe.setpoint_decision(
        JointState(name=list(GOAL), position=list(GOAL.values())), publisher)
    last_ns = stamp_of(ticks[-1]) + AFTER * scenario.plant.period_ns
    # Step to the end: a running plant may be faster than a delayed subscriber.
    step(AFTER + 5)
    probe.catch_up()
    # The plant repeats an unanswered tick unchanged, and so do the answers.
    return {topic: list({stamp_of(message): message for message in probe.received[topic]
                         if stamp_of(message) <= last_ns}.values()) for topic in TOPICS}


@pytest.mark.parametrize(
    'preset', [pytest.param('paper', marks=pytest.mark.slow), 'prototype'])
def test_every_sample_is_the_same(suite, make_probe, preset):
    """All bits agree, with noise, latency and dropout, under any load of the machine."""
    scenario = replace(load_scenario(preset), seed=11)
    expected = without_ros(scenario)
    found = over_topics(scenario, suite, make_probe(f'/{preset}'), f'/{preset}')
    for topic, fields in TOPICS.items():
        stamps = expected[f'{topic}.stamp_ns']
        if topic == 'link_angles':
            # The last samples of the run arrive with later ticks.
            del found[topic][len(stamps):]
        assert [stamp_of(message) for message in found[topic]] == stamps.tolist(), topic
        for field in fields:
            for row, message in zip(expected[f'{topic}.{field}'], found[topic]):
                given = row[~np.isnan(row)]
                assert given.tolist() == list(getattr(message, field)), (topic, field)
    # One preset commands efforts, the other one speeds.
    assert np.nanmax(np.abs(expected[f'flywheel_command.{COMMANDS[preset]}'])) > 0.0
    assert bool(found['flywheel_command'][-1].velocity) == (preset == 'prototype')
