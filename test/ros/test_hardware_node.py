# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The hardware node on a bus: order of start, end, lost, overheated and restarted links."""

from contextlib import ExitStack
from functools import partial
import signal
from socket import AF_INET, SOCK_DGRAM, socket
import time

from fourbar_ros.common.config_files import share_directory
from fourbar_ros.hardware.can_port import open_port
from fourbar_ros.hardware.dbc_codec import DbcCodec
from fourbar_ros.hardware.emulator import INJECTABLE_LINK_FAULTS
from fourbar_ros.hardware.messages import Command
from fourbar_ros.mechanism import LINK_NAMES
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically

pytestmark = pytest.mark.node

NOTHING = [0.0] * 4
# Slightly more than the bearing friction, so that every wheel stays slow enough for arming [N m].
TORQUES = [0.002, -0.002, 0.002, -0.002]
# The motor torque decays with a time constant of 3 ms; a torque below this is zero [N m].
FADED = 1e-6
# Command timeout of the emulated links [s].
LINKS_S = 0.1
# Time limit for the discovery to drop a dead node, which takes 20 s on a quiet machine [s].
FORGOTTEN_S = 60.0
# Time limit from the last command to zero torque: LINKS_S and a margin [ns].
COASTING_NS = 150_000_000
# Time limit from a bus fault to the last tick: rule `wheel_silent` and a margin [ns].
SILENT_NS = 500_000_000 + 100_000_000
# Time limit for an immediate reaction on a busy machine [ns].
AT_ONCE_NS = 2_500_000_000
# Largest age of a message that was delivered without a delay [ns].
YOUNG_NS = 100_000_000
# Time limit for the end of a node: two seconds, and a margin for a busy machine [s].
SHUTDOWN_S = 2.0 + 3.0

FAULT_PARAMETERS = ('trouble.bus', *(f'trouble.{name}' for name in LINK_NAMES))


def stamp_of(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def values_of(status):
    return {item.key: item.value for item in status.values}


def largest_torque(wheels):
    return max(map(abs, wheels.effort))


def free_channels(count):
    """Return unused addresses on this machine."""
    with ExitStack() as stack:
        ends = [stack.enter_context(socket(AF_INET, SOCK_DGRAM)) for _ in range(count)]
        for end in ends:
            end.bind(('127.0.0.1', 0))
        return [f'127.0.0.1:{end.getsockname()[1]}' for end in ends]


def on_bus(own, *peers):
    """Return the parameters of one end of a bus."""
    return {'bus.interface': 'fourbar_udp', 'bus.channel': own,
            'bus.options': f'peers={",".join(peers)}'}


def text_parameter(name, value):
    return Parameter(name=name, value=ParameterValue(
        type=ParameterType.PARAMETER_STRING, string_value=value))


class Bench:
    """
    Hardware node and emulated links in their own namespace, with a probe that sends commands.

    :param name: of the namespace.
    :param links_s: command timeout of the emulated links [s].
    :ivar host, ear: channels of the host, and of a third end that only listens.
    """

    def __init__(self, suite, make_probe, name, links_s=LINKS_S, fresh=False):
        self.name = name
        self.host, links, self.ear = free_channels(3)
        self.emulator = suite.node(
            'prototype_emulator', {**on_bus(links, self.host), 'command_timeout': links_s},
            f'/{name}')
        self.hardware = suite.node(
            'hardware', {**on_bus(self.host, links, self.ear), 'safety': 'emulated'}, f'/{name}',
            fresh=fresh)
        self.probe = make_probe(f'/{name}')
        self.probe.drive(NOTHING)
        self.truth = self.probe.follow('flywheel_states', 'link_angles', 'sim/link_states',
                                       'sim/flywheel_states')
        self.probe.newest('flywheel_states')
        self.probe.newest('sim/flywheel_states')
        self.probe.status('device_status')

    def arm(self):
        """Request arming until it is granted: clocks and limits are exchanged first."""
        self.probe.wait(lambda: self.probe.arm().success)

    def drive(self):
        """Drive until the motors give TORQUES; arm again after a command timeout."""
        self.arm()
        self.probe.drive(TORQUES)

        def done():
            if self.probe.state() == 'disarmed':
                self.probe.arm()
            return list(self.truth[-1].effort) == pytest.approx(TORQUES, rel=0.01)
        self.probe.wait(done)

    def set_parameter(self, name, value):
        """Set a parameter of the emulator; return whether it was accepted, and the reason."""
        result, = self.probe.call(
            SetParameters, 'prototype_emulator/set_parameters',
            SetParameters.Request(parameters=[text_parameter(name, value)])).results
        return result.successful, result.reason

    def inject(self, target, kind):
        """Inject a fault; return the system times between which it begins [ns]."""
        before_ns = time.time_ns()
        assert self.set_parameter(f'trouble.{target}', kind) == (True, '')
        return before_ns, time.time_ns()

    def last_driven_ns(self):
        """Wait until no motor gives torque; return the last stamp with torque [ns]."""
        self.probe.wait(lambda: largest_torque(self.truth[-1]) < FADED)
        return max(stamp_of(message) for message in self.truth
                   if largest_torque(message) > FADED)

    def assert_nothing_moves(self):
        """Check that no motor gives torque in the next 50 messages."""
        for message in self.probe.more('sim/flywheel_states', 50):
            assert largest_torque(message) < FADED

    def diagnostics(self, condition=lambda values: True):
        """Wait for values of the hardware node in /diagnostics that fulfil a condition."""
        return values_of(self.probe.diagnostics(
            f'{self.name}/hardware', lambda status: condition(values_of(status))))


@pytest.fixture(scope='module')
def shared(module_suite, make_probe):
    """Start one bench for all tests that restore its state."""
    return Bench(module_suite, make_probe, 'bench')


@pytest.fixture
def bench(shared):
    """Return the shared bench; remove faults and disarm after the test."""
    yield shared
    for name in FAULT_PARAMETERS:
        shared.set_parameter(name, '')
    shared.probe.drive(NOTHING)
    shared.probe.newest('flywheel_states')
    shared.probe.trigger('reset_emergency_stop')
    shared.probe.arm(False)
    shared.probe.status('device_status', state='disarmed')


# Bad input: first, while no other node runs

def write_changed(folder, name, old, new):
    """Write a changed copy of a file of the package, and return its path."""
    text = (share_directory() / 'config' / name).read_text()
    assert old in text
    path = folder / name
    path.write_text(text.replace(old, new))
    return path


# By case: node, parameters (`{...}` is an invalid file), and parts of the error message.
BUS = on_bus('127.0.0.1:0', '127.0.0.1:9')
BAD = {
    'unknown interface': (
        'hardware', {'bus.interface': 'smoke'}, 'smoke can0: no such interface', 'socketcan'),
    # The machine lacks either the interface or CAN in the kernel.
    'channel that is not there': (
        'hardware', {'bus.channel': 'can77'}, 'socketcan can77: ', ' no '),
    'port in use': (
        'prototype_emulator', {'bus.channel': '{taken}'}, 'cannot bind {taken}', 'in use'),
    'option without a value': (
        'hardware', {**BUS, 'bus.options': 'peers'}, "option 'peers' must be key=value"),
    'unknown option': (
        'hardware', {**BUS, 'bus.options': 'speed=3'}, 'knows no speed (only peers)'),
    'peer that is no address': (
        'prototype_emulator', {**BUS, 'bus.options': 'peers=nowhere'}, "'nowhere' is no address"),
    'DBC that is not there': (
        'hardware', {**BUS, 'dbc': '/nowhere/lab.dbc'}, 'DBC file /nowhere/lab.dbc: no such file'),
    'no DBC': (
        'hardware', {**BUS, 'dbc': '{no_dbc}'}, '{no_dbc}: not a usable DBC file', 'line 1'),
    'DBC that lacks a message': (
        'prototype_emulator', {**BUS, 'dbc': '{dbc}'}, '{dbc}: no message SYNC'),
    'safety that is not there': (
        'hardware', {**BUS, 'safety': '/nowhere/s.yaml'}, 'safety file /nowhere/s.yaml: no such'),
    'weakened safety': (
        'hardware', {**BUS, 'safety': '{safety}'},
        '{safety}: reboot.reaction must be at least coast, got warn'),
    'unknown codec': (
        'hardware', {**BUS, 'codec': 'morse'}, 'codec must be one of prototype, odrive'),
    'unknown links': (
        'prototype_emulator', {**BUS, 'links': 'xyz'}, "links must be some of abcd, got 'xyz'"),
    'no torque constants': (
        'hardware', {**BUS, 'codec': 'odrive', 'mechanism': 'paper'}, 'torque constants',
        'motor_torque_constants in the mechanism file'),
}


@pytest.fixture(scope='module')
def refused(module_suite, tmp_path_factory):
    """
    Start nodes with bad input in parallel, and wait until they end.

    :returns: process and expected parts of its error message, by case.
    """
    folder = tmp_path_factory.mktemp('bad')
    no_dbc = folder / 'no.dbc'
    no_dbc.write_text('good morning\n')
    with socket(AF_INET, SOCK_DGRAM) as taken:
        taken.bind(('127.0.0.1', 0))
        files = {
            'taken': f'127.0.0.1:{taken.getsockname()[1]}', 'no_dbc': no_dbc,
            'dbc': write_changed(folder, 'prototype.dbc', 'BO_ 128 SYNC:', 'BO_ 128 SINK:'),
            'safety': write_changed(
                folder, 'safety_prototype.yaml',
                'reboot:             {limit: 0.0, lasting: 0.0, reaction: stop}',
                'reboot:             {limit: 0.0, lasting: 0.0, reaction: warn}')}
        started = {
            case: (module_suite.node(
                node, {key: value.format(**files) for key, value in given.items()}, fresh=True),
                [word.format(**files) for word in words])
            for case, (node, given, *words) in BAD.items()}
        for process, _ in started.values():
            process.end(seconds=60.0)
    return started


@pytest.mark.parametrize('case', BAD)
def test_bad_input_ends_a_node_with_one_line(refused, case):
    process, words = refused[case]
    assert process.popen.returncode == 2, process.stderr
    line, = process.stderr.splitlines()
    assert line.startswith(f'fourbar {process.name}: ')
    for word in words:
        assert word in line
    assert process.stdout == ''


# Order of start

@pytest.mark.slow
def test_links_may_start_after_the_host_and_missing_links_are_named(suite, make_probe):
    """No link at first, then three links, then the fourth on a third end of the bus."""
    host, some, last = free_channels(3)
    suite.node('hardware', on_bus(host, some, last), '/late')
    probe = make_probe('/late')

    def reported(missing):
        return values_of(probe.diagnostics(
            'late/hardware', lambda status: values_of(status).get('missing', '') == missing))
    reported(f'waiting for {", ".join(LINK_NAMES)}: no heartbeat since start')
    refusal = probe.arm()
    assert not refusal.success
    for name in LINK_NAMES:
        assert f'{name}: no heartbeat since start' in refusal.message

    suite.node('prototype_emulator', {**on_bus(some, host), 'links': 'abd'}, '/some')
    reported('waiting for link_c: no heartbeat since start')
    refusal = probe.arm()
    assert not refusal.success
    assert 'link_c: no heartbeat since start' in refusal.message
    for name in ('link_a', 'link_b', 'link_d'):
        assert f'{name}: no heartbeat since start' not in refusal.message
    assert probe.follow('flywheel_states') == []
    assert probe.status('device_status')['state'] == 'disarmed'

    suite.node('prototype_emulator', {**on_bus(last, host), 'links': 'c'}, '/last')
    probe.drive(NOTHING)
    probe.wait(lambda: probe.arm().success)
    probe.status('device_status', state='armed')
    reported('')


# End of the node

@pytest.mark.parametrize(
    'number', [signal.SIGTERM, *(pytest.param(number, marks=pytest.mark.slow)
                                 for number in (signal.SIGINT, signal.SIGHUP))],
    ids=lambda number: number.name)
def test_last_commands_before_the_end_are_without_torque(suite, make_probe, number):
    """Links with a long command timeout coast at once."""
    bench = Bench(suite, make_probe, number.name.lower(), links_s=10.0, fresh=True)
    bench.drive()
    with open_port('fourbar_udp', bench.ear, options=f'peers={bench.host}') as ear:
        bench.probe.more('flywheel_states', 5)
        sent_ns = time.time_ns()
        assert bench.hardware.end(number, SHUTDOWN_S) == 0
        frames = []
        while (received := ear.receive(0.0)) is not None:
            frames.append(received[0])

    bench.hardware.check_clean()
    codec = DbcCodec('prototype')
    said = [codec.from_host(frame) for frame in frames]
    assert any(isinstance(message, Command) and message.enable for message in said)
    assert all(isinstance(message, Command) for message in said[-4:])
    assert [(message.link, message.value, message.by_speed, message.enable)
            for message in said[-4:]] == [(link, 0.0, False, False) for link in range(4)]
    assert bench.last_driven_ns() < sent_ns + AT_ONCE_NS
    assert bench.probe.status('device_status', state='disarmed')['reason'] == 'the node ends'


@pytest.mark.slow
def test_links_coast_by_themselves_when_the_host_is_killed(suite, make_probe):
    bench = Bench(suite, make_probe, 'killed')
    bench.drive()
    before_ns = time.time_ns()
    bench.hardware.kill()
    killed_ns = time.time_ns()
    assert before_ns < bench.last_driven_ns() < killed_ns + COASTING_NS
    # Wait until the discovery has dropped the dead node: Fast DDS deadlocks when a publisher is
    # destroyed at that moment, as at the end of the module.
    topic = bench.probe.node.resolve_topic_name('flywheel_states')
    for each in make_probe.probes:
        each.wait(lambda node=each.node: node.count_publishers(topic) == 0, FORGOTTEN_S)


# Faults on the bus

def test_wheels_coast_after_a_bus_fault_until_the_device_is_armed(bench):
    bench.drive()
    before_ns, off_ns = bench.inject('bus', 'off')
    status = bench.probe.status('device_status', state='disarmed')
    assert ': wheel_silent: ' in status['reason']
    assert before_ns < bench.last_driven_ns() < off_ns + COASTING_NS
    ticks = bench.probe.received['flywheel_states']
    assert stamp_of(ticks[-1]) < off_ns + SILENT_NS
    count = len(ticks)
    status = bench.probe.status('device_status', state='emergency_stop')
    assert ': heartbeat_lost: ' in status['reason']
    refusal = bench.probe.arm()
    assert not refusal.success
    assert ': heartbeat_lost: ' in refusal.message
    bench.assert_nothing_moves()
    assert len(ticks) == count

    bench.inject('bus', '')
    bench.probe.wait(lambda: len(ticks) > count + 50)
    # Commands arrive at every tick again.
    bench.assert_nothing_moves()
    assert bench.probe.status('device_status')['state'] == 'emergency_stop'

    bench.probe.trigger('reset_emergency_stop')
    bench.drive()


def test_restart_of_a_link_while_armed_is_an_emergency_stop(bench):
    bench.drive()
    _, begun_ns = bench.inject('link_b', 'reboot')
    reason = 'link_b: reboot: the link has restarted while armed'
    bench.probe.status('device_status', state='emergency_stop', reason=reason)
    values = bench.diagnostics(lambda values: values['state'] == 'emergency_stop')
    assert values['reason'] == reason
    assert int(values['link_b.restarts']) >= 1
    assert values['link_a.restarts'] == '0'
    assert bench.last_driven_ns() < begun_ns + AT_ONCE_NS
    assert 'emergency_stop' in bench.probe.arm().message
    bench.assert_nothing_moves()


def test_overtemperature_of_a_link_disarms_and_is_reported(bench):
    bench.drive()
    _, begun_ns = bench.inject('link_c', 'hot')
    reason = 'link_c: overtemperature: temperature 90 deg C, limit 80 deg C'
    bench.probe.status('device_status', state='disarmed', reason=reason)
    values = bench.diagnostics(lambda values: values['state'] == 'disarmed')
    assert values['reason'] == reason
    assert values['link_c'].startswith(reason)
    assert values['link_c.temperature_deg_c'] == '90.0'
    assert bench.last_driven_ns() < begun_ns + AT_ONCE_NS
    assert reason in bench.probe.arm().message
    bench.inject('link_c', '')
    bench.drive()


# The emulator

def test_unknown_fault_is_refused_with_the_known_ones(bench):
    accepted, reason = bench.set_parameter('trouble.link_a', 'nonsense')
    assert not accepted
    assert reason == (f'fault of link_a must be one of {", ".join(INJECTABLE_LINK_FAULTS)}, '
                      "got 'nonsense'")
    found, = bench.probe.call(
        GetParameters, 'prototype_emulator/get_parameters',
        GetParameters.Request(names=['trouble.link_a'])).values
    assert found.string_value == ''


@pytest.mark.parametrize('bad', ['trouble.link_d', 'fault.link_d'])
def test_faults_set_together_are_injected_all_or_none(bench, bad):
    result = bench.probe.call(
        SetParametersAtomically, 'prototype_emulator/set_parameters_atomically',
        SetParametersAtomically.Request(parameters=[
            text_parameter('trouble.link_a', 'hot'), text_parameter(bad, 'nonsense')])).result
    assert not result.successful
    assert 'link_d' in result.reason
    values = bench.diagnostics()
    assert values['link_a.temperature_deg_c'] == '30.0'


def steps_at(messages, period_ns):
    """Return the steps of the last 200 stamps [ns] if their median is a period, else nothing."""
    steps = np.diff([stamp_of(message) for message in messages[-200:]]).tolist()
    return steps if np.median(steps) == period_ns else []


def test_truth_is_published_at_250_hz_with_system_time(bench):
    odometry = bench.probe.follow('sim/odometry', kind=Odometry)
    bench.probe.more('sim/ledger', 3)
    bench.probe.wait(lambda: len(odometry) > 250)
    for topic in ('sim/link_states', 'sim/flywheel_states', 'sim/odometry'):
        messages = bench.probe.received[topic]
        # The median ignores messages that a delayed process skips; a busy machine may delay more
        # than half of them for a while.
        steps = bench.probe.wait(partial(steps_at, messages, 4_000_000))
        assert min(steps) > 0
    truth = bench.probe.received['sim/link_states']
    newest = bench.probe.wait(lambda: next(
        (message for message in truth[-1:]
         if time.time_ns() - stamp_of(message) < YOUNG_NS), None))
    assert time.time_ns() > stamp_of(newest)


def test_truth_agrees_with_link_angles_within_their_noise(bench):
    """The links move, so that an error of the stamps would appear too."""
    bench.drive()
    # The mean of 400 samples of a link has a standard error of 9e-5 rad.
    samples = bench.probe.more('link_angles', 1600)
    truth = bench.probe.received['sim/link_states']
    bench.probe.wait(lambda: stamp_of(truth[-1]) > max(map(stamp_of, samples)))
    times = [stamp_of(message) for message in truth]
    origin_ns = times[0]
    known = (np.array(times) - origin_ns) * 1e-9
    for index, name in enumerate(LINK_NAMES):
        of_link = [message for message in samples if name in message.name]
        assert len(of_link) > 200
        angles = np.array([message.position[message.name.index(name)] for message in of_link])
        true = np.interp(
            np.array([stamp_of(message) - origin_ns for message in of_link]) * 1e-9, known,
            np.unwrap([message.position[index] for message in truth]))
        errors = np.angle(np.exp(1j * (angles - true)))
        # Noise of a tenth of a degree, as in the table of the prototype.
        assert np.sqrt(np.mean(errors ** 2)) == pytest.approx(1.7453e-3, rel=0.35)
        assert np.abs(errors.mean()) < 5e-4
        assert np.abs(errors).max() < 6 * 1.7453e-3


@pytest.mark.slow
def test_emulator_reports_once_that_the_linkage_met_the_edge_of_the_table(
        suite, make_probe, tmp_path):
    """The table of the test is steep and narrow, so that the linkage slides to its edge."""
    text = (share_directory() / 'config' / 'table_prototype.yaml').read_text()
    lines = [f'  {name}: {values[name]}' if (name := line.split(':')[0].strip()) in (
        values := {'tilt_x': 0.002, 'size_x': 0.47}) else line for line in text.splitlines()]
    table = tmp_path / 'steep.yaml'
    table.write_text('\n'.join(lines))
    own, unused = free_channels(2)
    emulator = suite.node(
        'prototype_emulator', {**on_bus(own, unused), 'table': str(table)}, '/edge')
    probe = make_probe('/edge')
    probe.follow('sim/link_states')
    probe.wait(lambda: 'met the edge of the table' in emulator.stderr)
    probe.more('sim/link_states', 250)
    assert emulator.stderr.count('the linkage has met the edge of the table') == 1
