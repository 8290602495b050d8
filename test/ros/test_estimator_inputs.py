# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The estimator node with ticks and samples that the devices of the package never send."""

from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
import pytest
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.node

PERIOD_NS = 4_000_000
FIRST_NS = 1_000_000_000
ANGLES = [0.1, 1.2, 0.1, 1.2]


class Device:
    """
    A publisher of samples, and of ticks with given fields.

    :param testbed: probe that publishes.
    """

    def __init__(self, testbed):
        self._testbed = testbed
        self._angles = testbed.publisher(JointState, 'link_angles')
        self._wheels = testbed.publisher(JointState, 'flywheel_states')
        self._estimates = testbed.follow('estimate/link_states')
        self.stamp_ns = FIRST_NS

    def _message(self, names, **fields):
        message = JointState(name=list(names), **fields)
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(self.stamp_ns, 1_000_000_000)
        return message

    def tick(self, rates=(), **wheels):
        """Publish samples and ticks until there is an estimate."""
        before = len(self._estimates)

        def answered():
            self.stamp_ns += PERIOD_NS
            self._angles.publish(self._message(LINK_NAMES, position=ANGLES, velocity=list(rates)))
            self._wheels.publish(self._message(FLYWHEEL_NAMES, **wheels))
            self._testbed.catch_up()
            return len(self._estimates) > before
        # The estimator loses messages that are sent before it has discovered the publisher.
        self._testbed.wait(answered)

    def command(self, efforts):
        """Command the wheels; the estimator subscribes only after a tick without efforts."""
        self._testbed.publisher(JointState, 'flywheel_command').publish(
            self._message(FLYWHEEL_NAMES, effort=efforts))


@pytest.fixture(scope='module')
def namespace(module_suite):
    module_suite.node('estimator', {'mechanism': 'paper'}, '/alone')
    return '/alone'


@pytest.fixture(scope='module')
def device(namespace, make_probe):
    testbed = make_probe(namespace)
    return namespace, testbed, Device(testbed)


def test_missing_wheel_speeds_are_replaced_and_reported(device):
    """Efforts, then commands, then speeds again drive the prediction; diagnostics name each."""
    namespace, testbed, plant = device

    def driven(by):
        status = testbed.diagnostics(f'{namespace[1:]}/estimator', lambda status: any(
            item.key == 'driven_by' and item.value == by for item in status.values))
        return status.message
    plant.tick(velocity=[0.0] * 4)
    plant.tick(velocity=[0.0] * 4)
    assert driven('wheel speeds') == 'running'
    plant.tick(effort=[1e-6] * 4)
    assert driven('wheel efforts') == 'running without wheel speeds, driven by wheel efforts'
    plant.tick()
    assert driven('nothing') == 'running without wheel speeds, driven by nothing'
    plant.command([1e-6] * 4)

    def driven_by_commands():
        plant.tick()
        return any(item.key == 'driven_by' and item.value == 'commanded efforts'
                   for status in [testbed.diagnostics(f'{namespace[1:]}/estimator')]
                   for item in status.values)
    testbed.wait(driven_by_commands)
    plant.tick(velocity=[0.0] * 4)
    plant.tick(velocity=[0.0] * 4)
    assert driven('wheel speeds') == 'running'


def test_gyros_and_decisions_are_published(device):
    _, testbed, plant = device
    biases = testbed.follow('estimate/gyro_bias')
    decisions = testbed.follow('estimate/decisions')
    disturbances = testbed.follow('estimate/disturbance')
    assert not testbed.node.count_publishers(testbed.node.resolve_topic_name('estimate/gyro_bias'))

    def published():
        plant.tick(rates=[0.01, 0.02, -0.01, 0.0], velocity=[0.0] * 4)
        return biases and decisions and disturbances
    testbed.wait(published)
    assert list(biases[-1].name) == list(LINK_NAMES) and len(biases[-1].velocity) == 4
    assert list(decisions[-1].name) == list(LINK_NAMES)
    assert list(decisions[-1].position) == [0.0] * 4
    assert list(decisions[-1].effort) == [1.0] * 4
    assert list(disturbances[-1].name) == ['torque_a', 'torque_b', 'sigma_a', 'sigma_b']
