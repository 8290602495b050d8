# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Interface of a device: the same tests for the plant and for the prototype on its bus."""

from math import inf, nan, pi
import signal

from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

pytestmark = pytest.mark.node

PERIOD_NS = 4_000_000
COMMAND_TIMEOUT_S = 1.0
TORQUES = [0.004, -0.002, 0.003, -0.004]
LIMIT = 0.05
NOTHING = [0.0] * 4
# The motor torque decays with a time constant of 3 ms; a torque below this is zero [N m].
FADED = 1e-6

JOINT_STATE, STATUS = 'sensor_msgs/msg/JointState', 'diagnostic_msgs/msg/DiagnosticStatus'
PUBLISHED = {'link_angles': JOINT_STATE, 'flywheel_states': JOINT_STATE, 'timing': JOINT_STATE,
             'device_status': STATUS}
TAKEN = {'flywheel_command': JOINT_STATE, 'emergency_stop_request': 'std_msgs/msg/Bool'}
SERVICES = {'arm': 'std_srvs/srv/SetBool', 'emergency_stop': 'std_srvs/srv/Trigger',
            'reset_emergency_stop': 'std_srvs/srv/Trigger'}
SIM = '/sim/'

# Commands with one defect each, by the counter of their rejection.
WRONG = {
    'finite': [{'effort': [nan, *NOTHING[1:]]}, {'effort': [0.0, inf, 0.0, 0.0]},
               {'velocity': [0.0, 0.0, -inf, 0.0]}],
    'names': [{'names': ['flywheel_a', 'flywheel_a'], 'effort': [0.001, 0.001]},
              {'names': ['link_a'], 'effort': [0.001]}],
    'length': [{'effort': [0.001]}, {'names': [], 'effort': []}],
    'fields': [{'effort': [0.001] * 4, 'velocity': [1.0] * 4}, {'position': [1.0] * 4}],
}


def stamp_of(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


class Bench:
    """
    A device in its own namespace, with a probe that sends commands.

    :ivar name: name of the node.
    """

    def __init__(self, name, processes, probe):
        self.name, self.processes, self.probe = name, processes, probe

    @property
    def newest(self):
        """The newest tick."""
        return self.probe.received['flywheel_states'][-1]

    def full_name(self, relative):
        return f'/{self.name}/{relative}'

    def arm(self):
        """Request arming until it is granted: clocks and limits are exchanged first."""
        self.probe.wait(lambda: self.probe.arm().success)

    def gives(self, torques):
        """Return whether the motors give these torques."""
        return list(self.newest.effort) == pytest.approx(torques, rel=1e-3, abs=FADED)

    def drive(self, torques):
        """Drive until the motors give these torques; arm again after a command timeout."""
        self.probe.drive(torques)

        def done():
            if self.probe.state() == 'disarmed':
                self.probe.arm()
            return self.gives(torques)
        self.probe.wait(done)

    def counts(self, prefix, fresh=True):
        return self.probe.counts(f'{self.name}/{self.name}', prefix, fresh)


@pytest.fixture(scope='module', params=['plant', 'hardware'])
def bench(request, module_suite, make_probe):
    name = request.param
    processes = module_suite.device(name, namespace=f'/{name}')
    probe = make_probe(f'/{name}')
    probe.drive(NOTHING)
    probe.follow('flywheel_states', 'link_angles', 'timing')
    for topic in ('link_angles', 'flywheel_states', 'timing'):
        probe.newest(topic)
    probe.status('device_status')
    yield Bench(name, processes, probe)
    probe.drive(None)
    # The nodes of the next device need the processor.
    for process in reversed(processes.values()):
        process.end(signal.SIGINT)
        process.check_clean()


@pytest.fixture(autouse=True)
def released(bench):
    """Leave the device disarmed."""
    yield
    bench.probe.drive(NOTHING)
    bench.probe.trigger('reset_emergency_stop')
    bench.probe.arm(False)
    bench.probe.status('device_status', state='disarmed')
    bench.probe.wait(lambda: bench.gives(NOTHING))


def torque_since(bench, begin):
    """Return the largest torque in the ticks from an index on [N m]."""
    return max(np.abs(tick.effort).max()
               for tick in bench.probe.received['flywheel_states'][begin:])


# Names, types, quality of service

def test_device_publishes_the_documented_topics(bench):
    node = bench.probe.node
    found = dict(node.get_publisher_names_and_types_by_node(bench.name, f'/{bench.name}'))
    of_devices = {topic: kinds for topic, kinds in found.items()
                  if topic.startswith(f'/{bench.name}/') and SIM not in topic}
    assert of_devices == {bench.full_name(topic): [kind] for topic, kind in PUBLISHED.items()}
    assert '/diagnostics' in found
    for topic in PUBLISHED:
        info, = node.get_publishers_info_by_topic(bench.full_name(topic))
        latched = topic == 'device_status'
        assert info.qos_profile.reliability is ReliabilityPolicy.RELIABLE
        assert info.qos_profile.durability is (
            DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)


def test_device_subscribes_to_the_documented_topics(bench):
    node = bench.probe.node
    found = dict(node.get_subscriber_names_and_types_by_node(bench.name, f'/{bench.name}'))
    for topic, kind in TAKEN.items():
        assert found[bench.full_name(topic)] == [kind]
        of_it = [info for info in node.get_subscriptions_info_by_topic(bench.full_name(topic))
                 if info.node_name == bench.name]
        assert [info.qos_profile.reliability for info in of_it] == [ReliabilityPolicy.RELIABLE]
        assert [info.qos_profile.durability for info in of_it] == [DurabilityPolicy.VOLATILE]


def test_device_offers_the_documented_services(bench):
    found = dict(bench.probe.node.get_service_names_and_types_by_node(
        bench.name, f'/{bench.name}'))
    for service, kind in SERVICES.items():
        assert found[bench.full_name(service)] == [kind]


def test_names_are_in_order_and_unused_fields_are_empty(bench):
    tick = bench.probe.more('flywheel_states')[0]
    assert tuple(tick.name) == FLYWHEEL_NAMES
    assert [len(values) for values in (tick.position, tick.velocity, tick.effort)] == [4, 4, 4]
    for message in bench.probe.more('link_angles', 40):
        assert message.header.frame_id == 'table'
        assert [name for name in LINK_NAMES if name in message.name] == list(message.name)
        assert len(message.position) == len(message.name)
        assert not message.velocity
        assert not message.effort
        assert all(-pi < angle <= pi for angle in message.position)
    timing = bench.probe.more('timing')[0]
    assert {'lost', 'step_s'} <= set(timing.name)
    assert np.isfinite(timing.position).all()


# Rates and stamps

def test_ticks_have_the_rate_and_are_on_a_grid(bench):
    stamps = [stamp_of(message) for message in bench.probe.more('flywheel_states', 250)]
    steps = np.diff(stamps)
    assert (steps > 0).all()
    assert not (steps % PERIOD_NS).any()
    now_ns = bench.probe.node.get_clock().now().nanoseconds
    assert 0 <= now_ns - stamps[-1] < 10_000_000_000


def test_stamps_of_angles_are_times_of_measurement(bench):
    """Each link measures at 250 Hz, and the sample arrives 5 ms later."""
    bench.probe.catch_up()
    begin = len(bench.probe.received['flywheel_states'])
    angles = bench.probe.more('link_angles', 300)
    ticks = [stamp_of(tick) for tick in bench.probe.received['flywheel_states'][begin:]]
    for link in LINK_NAMES:
        stamps = [stamp_of(message) for message in angles if link in message.name]
        steps = np.diff(stamps)
        assert (steps > 0).all()
        # The clock of a link is known to a tenth of a millisecond over a bus.
        off = (steps + PERIOD_NS // 2) % PERIOD_NS - PERIOD_NS // 2
        assert np.median(np.abs(off)) < 100_000
        assert np.median(steps) == pytest.approx(PERIOD_NS, abs=100_000)
        assert min(ticks[-1] - stamp for stamp in stamps) < 50_000_000


# Arming

def test_nothing_moves_before_it_is_armed(bench):
    bench.probe.drive(TORQUES)
    begin = len(bench.probe.received['flywheel_states'])
    bench.probe.more('flywheel_states', 50)
    assert torque_since(bench, begin) < FADED


def test_torque_is_as_commanded_while_armed_and_zero_while_disarmed(bench):
    bench.arm()
    assert bench.probe.status('device_status', state='armed')['reason'] == 'armed on request'
    bench.drive(TORQUES)
    assert bench.probe.arm(False).success
    bench.probe.status('device_status', state='disarmed', reason='disarmed on request')
    bench.probe.wait(lambda: bench.gives(NOTHING))


def test_second_publisher_of_commands_prevents_arming(bench):
    rival = bench.probe.node.create_publisher(JointState, 'flywheel_command', 10)

    def refused():
        response = bench.probe.arm()
        if response.success:
            bench.probe.arm(False)
        return not response.success and response.message
    assert bench.probe.wait(refused) == 'refused: flywheel_command has 2 publishers, limit 1'
    bench.probe.node.destroy_publisher(rival)


# Command timeout, emergency stop, limits

def test_wheels_coast_after_the_command_timeout(bench):
    bench.arm()
    bench.drive(TORQUES)
    bench.probe.drive(None)
    status = bench.probe.status('device_status', state='disarmed')
    assert status['reason'] == f'no flywheel_command for {COMMAND_TIMEOUT_S:g} s'
    bench.probe.wait(lambda: bench.gives(NOTHING))


@pytest.mark.parametrize('way', ['service', 'topic'])
def test_emergency_stop_is_latched_until_reset(bench, way):
    bench.arm()
    bench.drive(TORQUES)
    if way == 'service':
        assert bench.probe.trigger('emergency_stop').success
    else:
        request = bench.probe.publisher(Bool, 'emergency_stop_request')
        request.publish(Bool(data=False))
        request.publish(Bool(data=True))
    bench.probe.status('device_status', state='emergency_stop')
    bench.probe.wait(lambda: bench.gives(NOTHING))
    refused = bench.probe.arm()
    assert not refused.success
    assert 'emergency_stop' in refused.message
    assert bench.probe.trigger('reset_emergency_stop').success
    bench.probe.status('device_status', state='disarmed', reason='emergency_stop was reset')
    bench.arm()
    bench.drive(TORQUES)
    if way == 'topic':
        bench.probe.node.destroy_publisher(request)


def test_too_much_torque_is_clipped_and_counted(bench):
    bench.arm()
    before = bench.counts('commands_clipped', fresh=False)['']
    asked, given = [1.0, -1.0, 0.02, 0.0], [LIMIT, -LIMIT, 0.02, 0.0]
    bench.probe.drive(asked)

    def done():
        if bench.probe.state() == 'disarmed':
            bench.probe.arm()
        return bench.gives(given)
    bench.probe.wait(done)
    bench.probe.drive(NOTHING)
    assert bench.counts('commands_clipped')[''] > before


# Commands

@pytest.mark.parametrize('kind', list(WRONG))
def test_command_with_a_defect_is_rejected_as_a_whole_and_counted(bench, kind):
    bench.arm()
    before = bench.counts('commands_rejected_', fresh=False).get(kind, 0)
    begin = len(bench.probe.received['flywheel_states'])
    for command in WRONG[kind]:
        bench.probe.command(stamp_of(bench.newest), **command)
    bench.probe.wait(lambda: bench.counts('commands_rejected_').get(kind, 0)
                     >= before + len(WRONG[kind]))
    assert bench.counts('commands_rejected_', fresh=False)[kind] == before + len(WRONG[kind])
    assert torque_since(bench, begin) < FADED


@pytest.mark.parametrize('away_ns', [-1_200_000_000, 1_000_000_000])
def test_stale_command_is_rejected(bench, away_ns):
    bench.arm()
    before = bench.counts('commands_rejected_', fresh=False).get('stale', 0)
    begin = len(bench.probe.received['flywheel_states'])
    bench.probe.command(stamp_of(bench.newest) + away_ns, effort=TORQUES)
    bench.probe.wait(lambda: bench.counts('commands_rejected_').get('stale', 0) > before)
    assert torque_since(bench, begin) < FADED


def test_wheels_are_addressed_by_name_and_a_missing_one_has_no_torque(bench):
    bench.arm()
    bench.probe.drive(None)

    def done():
        if bench.probe.state() == 'disarmed':
            bench.probe.arm()
        bench.probe.command(stamp_of(bench.newest), names=['flywheel_c', 'flywheel_a'],
                            effort=[0.002, 0.003])
        return bench.gives([0.003, 0.0, 0.002, 0.0])
    bench.probe.wait(done)


def test_wheels_follow_a_commanded_speed(bench):
    bench.arm()
    bench.probe.drive(None)

    def done():
        if bench.probe.state() == 'disarmed':
            bench.probe.arm()
        bench.probe.command(stamp_of(bench.newest), velocity=[15.0, -10.0, 5.0, 0.0])
        # One count of the encoder per period is 0.1 rad/s.
        return list(bench.newest.velocity) == pytest.approx([15.0, -10.0, 5.0, 0.0], abs=0.25)
    bench.probe.wait(done)
