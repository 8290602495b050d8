# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Nodes in their own processes on their own domain, and a probe that watches them."""

from contextlib import contextmanager, suppress
import fcntl
import gc
from importlib.util import module_from_spec, spec_from_file_location
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
from threading import Thread
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from fourbar_ros.common.config_files import share_directory
from fourbar_ros.hardware.bus_settings import free_addresses
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism import FLYWHEEL_NAMES
import pytest
import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

# Tests are no package: shared code is loaded from its file.
_spec = spec_from_file_location('fork_server', Path(__file__).with_name('fork_server.py'))
_fork_server = module_from_spec(_spec)
_spec.loader.exec_module(_fork_server)

# Longest wait for a condition [s of LoadClock].
DEADLINE_S = 20.0
# Command timeout of the devices in tests [s]: longer than other processes delay one here.
COMMAND_TIMEOUT_S = 1.0
# Time after which the first response of a service counts as lost [s of LoadClock].
RETRY_INTERVAL_S = 3.0
DOMAINS = range(1, 102)
# Domains in which a process was killed: locks in its shared memory may never be released.
spoiled_domains = set()


class LoadClock:
    """
    A clock that slows down with the load of the machine.

    A thread sleeps and then computes for WORK_S of processor time. On a quiet machine that takes
    just this time from the end of the sleep; beside other processes it takes longer, by the factor
    by which every process here is slower. The clock runs slower by that factor.
    """

    SLEEP_S = 0.05
    WORK_S = 0.001

    def __init__(self):
        self.slowdown = 1.0
        self._seconds = 0.0
        self._updated = time.monotonic()
        self._thread = None

    def now(self):
        """Return the time [s]; the first call starts the measurement."""
        if self._thread is None:
            self._thread = Thread(target=self._measure, daemon=True)
            self._thread.start()
        return self._seconds + (time.monotonic() - self._updated) / self.slowdown

    def wait(self, condition, seconds=DEADLINE_S, interval=0.02):
        """Poll a condition until it holds; fail after a time of this clock."""
        end = self.now() + seconds
        while not condition():
            assert self.now() < end, 'timeout'
            time.sleep(interval)

    def sleep(self, seconds):
        """Sleep for a time of this clock."""
        end = self.now() + seconds
        while self.now() < end:
            time.sleep(0.01)

    def _measure(self):
        while True:
            due, work = time.monotonic() + self.SLEEP_S, time.thread_time() + self.WORK_S
            time.sleep(self.SLEEP_S)
            while time.thread_time() < work:
                pass
            slowdown = max(1.0, (time.monotonic() - due) / self.WORK_S)
            self._seconds, self._updated = self.now(), time.monotonic()
            # Smoothed over about a second; limited, so that a failing test still ends.
            self.slowdown = min(10.0, 0.95 * self.slowdown + 0.05 * slowdown)


CLOCK = LoadClock()

DEEP = QoSProfile(depth=5000)
COMMAND = QoSProfile(depth=10)
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# Nodes end in this order, so that no node reports the silence of another one.
STOP_ORDER = ('record', 'controller', 'estimator', 'plant', 'hardware', 'prototype_emulator')

# Processes of each kind of device; the last one has the topics.
DEVICES = {'plant': ('plant',), 'hardware': ('prototype_emulator', 'hardware')}


def stamp_of(message):
    """Return the stamp of a message [ns]."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def set_stamp(message, stamp_ns):
    """Write a stamp [ns] into a message, and return it."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    return message


def values_of(status):
    """Return the values of a DiagnosticStatus as a dict."""
    return {item.key: item.value for item in status.values}


@contextmanager
def claimed_domain():
    """Hold a ROS domain that no other test run on this machine uses, under a lock file."""
    for number in (number for number in DOMAINS if number not in spoiled_domains):
        path = Path(tempfile.gettempdir(), f'fourbar_ros_domain_{number}.lock')
        try:
            lock = path.open('w')
        except OSError:     # another user's
            continue
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(lock.fileno()).st_ino != path.stat().st_ino:
                    continue    # removed by its holder while we opened it
            except (BlockingIOError, FileNotFoundError):
                continue
            try:
                yield number
            finally:
                path.unlink()
            return
    pytest.fail('every domain from 1 to 101 is taken')


def on_a_bus():
    """Return parameters with which a host and its links find each other, on free ports."""
    host, links = free_addresses(2)
    return {name: {'bus.interface': 'fourbar_udp', 'bus.channel': own,
                   'bus.options': f'peers={other}'}
            for name, own, other in (
                ('hardware', host, links), ('prototype_emulator', links, host))}


class Process:
    """
    One `fourbar NAME ...` in its own process.

    :param folder: folder of the files with stdout and stderr.
    :param shared_memory: records the shared-memory files of the process.
    :param fork_server: forks the process; None starts a fresh interpreter.
    :ivar awaited: whether a test has waited for the end of the process.
    """

    def __init__(self, name, arguments, folder, shared_memory, fork_server):
        self.name = name
        self.awaited = False
        self._shared_memory = shared_memory
        self._out, self._err = (folder / f'{stream}.txt' for stream in ('stdout', 'stderr'))
        if fork_server is not None:
            self._out.touch()
            self._err.touch()
            self.popen = fork_server.start(
                [name, *arguments], folder, self._out, self._err, dict(os.environ))
            return
        with self._out.open('wb') as out, self._err.open('wb') as err:
            self.popen = subprocess.Popen(
                [sys.executable, '-m', 'fourbar_ros', name, *arguments], cwd=folder,
                stdin=subprocess.DEVNULL, stdout=out, stderr=err)

    @property
    def stdout(self):
        """The text on stdout so far."""
        return self._out.read_text()

    @property
    def stderr(self):
        """The text on stderr so far."""
        return self._err.read_text()

    def send(self, number):
        """Send a signal."""
        self.popen.send_signal(number)

    def end(self, number=None, seconds=2 * DEADLINE_S):
        """Send a signal if one is given, wait for the end, and return the exit code."""
        self.awaited = True
        if self.popen.poll() is None:
            self._shared_memory.note(self.popen.pid)
            if number is not None:
                self.popen.send_signal(signal.SIGCONT)
                self.popen.send_signal(number)
        CLOCK.wait(lambda: self.popen.poll() is not None, seconds, 0.01)
        return self.popen.returncode

    def kill(self):
        """Kill the process."""
        self.awaited = True
        self._shared_memory.note(self.popen.pid)
        self._shared_memory.spoiled = True
        self.popen.kill()
        self.popen.wait()

    def check_clean(self):
        """Fail unless the process ended with exit code 0 and printed no error."""
        assert (self.name, self.popen.returncode) == (self.name, 0), self.stderr
        for word in ('Traceback', 'FATAL', 'Error', 'terminate called'):
            assert word not in self.stdout + self.stderr


def shared_memory_of(pid):
    """Return the shared-memory files that a process owns: it keeps their lock files open."""
    names = set()
    for link in Path(f'/proc/{pid}/fd').iterdir():
        with suppress(OSError):     # closed in the meantime
            target = Path(os.readlink(link))
            if target.parent == Path('/dev/shm') and target.name.endswith('_el'):
                names.add(target.name[:-len('_el')])
    return {Path('/dev/shm', form.format(name)) for name in names
            for form in ('{}', '{}_el', 'sem.{}_mutex')}


class SharedMemory:
    """
    Files of the middleware in /dev/shm for the processes of a module.

    :ivar seen: files that the processes owned at some time.
    :ivar spoiled: whether a process was killed; the files of a killed process stay.
    """

    def __init__(self):
        self.seen = set()
        self.spoiled = False

    def note(self, pid):
        """Record the files that a process owns now."""
        with suppress(OSError):     # it ended by itself
            self.seen |= shared_memory_of(pid)

    def left(self):
        """Return the files that no running process owns."""
        left = {path for path in self.seen if path.exists()}
        for folder in Path('/proc').glob('[0-9]*') if left else ():
            with suppress(OSError):     # it ended, or is another user's
                left -= shared_memory_of(folder.name)
        return left

    def check(self):
        """Fail if files are left after the end of all processes; after a kill remove them."""
        if self.spoiled:
            for path in self.left():
                path.unlink(missing_ok=True)
        # Ports from 7000 on are common to all domains: another process may hold them.
        assert [path for path in self.left() if 'port70' not in path.name] == []


class Suite:
    """
    Processes of one test or module, which end with the test or module.

    :param folder: folder of the files with stdout and stderr.
    :param shared_memory: records the shared-memory files of the processes.
    :param fork_server: forks the processes that need no fresh interpreter.
    """

    def __init__(self, folder, shared_memory, fork_server):
        self.folder = folder
        self._shared_memory = shared_memory
        self._fork_server = fork_server
        self._started = []

    def start(self, name, *arguments, fresh=False):
        """
        Start `fourbar NAME ARGUMENTS`.

        :param fresh: use a new interpreter, as a user does, for tests of how processes start and
            end.
        """
        folder = self.folder / f'{len(self._started)}_{name}'
        folder.mkdir()
        process = Process(
            name, arguments, folder, self._shared_memory, None if fresh else self._fork_server)
        self._started.append(process)
        return process

    def node(self, name, parameters=None, namespace='', arguments=(), fresh=False):
        """Start a node with parameters in a namespace; a plant has a long command timeout."""
        ros_args = ['--ros-args']
        patience = ({'command_timeout': COMMAND_TIMEOUT_S}
                    if name in ('plant', 'hardware', 'prototype_emulator') else {})
        for key, value in {**patience, **(parameters or {})}.items():
            ros_args += ['-p', f'{key}:={value}']
        if namespace:
            ros_args += ['-r', f'__ns:={namespace}']
        ros_args += arguments
        return self.start(name, *(ros_args if ros_args[1:] else ()), fresh=fresh)

    @staticmethod
    def bus():
        """Return parameters with which the nodes on a bus find each other."""
        return on_a_bus()

    def device(self, device, parameters=None, namespace='', emulator=None):
        """
        Start a device of the bench scale, simulated or on a bus, and return its processes.

        :param parameters: of the node with the topics.
        :param emulator: parameters of the emulated links, for a device on a bus.
        """
        given = {name: {'mechanism': 'prototype'} for name in DEVICES[device]}
        if device == 'plant':
            given['plant']['table'] = 'prototype'
        else:
            for name, values in on_a_bus().items():
                given[name].update(values)
            given['hardware']['safety'] = 'emulated'
            given['prototype_emulator'].update(emulator or {})
        given[device].update(parameters or {})
        return {name: self.node(name, given[name], namespace) for name in DEVICES[device]}

    def nodes(self, namespace='', fresh=False, **parameters):
        """Start plant, estimator and controller with parameters by the name of the node."""
        return {name: self.node(name, parameters.get(name), namespace, fresh=fresh)
                for name in ('plant', 'estimator', 'controller')}

    def close(self):
        """Stop the nodes that still run and check that all ended cleanly."""
        # A test that waited for a process has checked its end.
        unwatched = [process for process in self._started if not process.awaited]
        try:
            for process in sorted(unwatched, key=lambda one: STOP_ORDER.index(one.name)):
                process.end(signal.SIGINT)
            for process in unwatched:
                process.check_clean()
        finally:
            for process in self._started:
                if process.popen.poll() is None:
                    process.kill()


class Probe:
    """
    A node of the tests: it subscribes, calls services, sends commands, and waits for conditions.

    :ivar received: list of messages by the topic's relative name, see `follow`.
    """

    def __init__(self, domain, namespace=''):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain,
                   signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node('probe', context=self.context, namespace=namespace or None,
                         enable_rosout=False, start_parameter_services=False)
        self._executor = EventsExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.received = {}
        self._every_tick = {}
        self._clients = {}
        self._driving = None
        self._torques = [0.0] * 4

    def close(self):
        """End ROS in this context."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def wait(self, condition, seconds=DEADLINE_S, instead=lambda: ''):
        """
        Run callbacks until a condition holds, and return what it returned.

        :param seconds: longest wait [s of LoadClock].
        :param instead: returns the present state, for the message of a timeout.
        """
        end = CLOCK.now() + seconds
        while not (result := condition()):
            assert CLOCK.now() < end, f'timeout {instead()}'
            self._executor.spin_once(timeout_sec=0.02)
        return result

    def catch_up(self):
        """Handle every message that has arrived by now."""
        # The executor serves in the order of arrival.
        task = self._executor.create_task(lambda: None)
        self.wait(task.done)

    def follow(self, *topics, kind=JointState, qos=DEEP):
        """Collect the messages of some topics, and return the list of the last topic."""
        for topic in topics:
            if topic not in self.received:
                self.received[topic] = []
                subscription = self.node.create_subscription(
                    kind, topic, self.received[topic].append, qos)
                if kind is JointState:
                    self._every_tick[topic] = subscription
        return self.received[topics[-1]]

    def unfollow(self):
        """
        End the subscriptions to topics of every tick.

        Two cores that run three nodes are too slow to receive messages that no test reads.
        """
        for topic, subscription in self._every_tick.items():
            self.node.destroy_subscription(subscription)
            del self.received[topic]
        self._every_tick.clear()

    def newest(self, topic):
        """Follow a topic, wait for a message, and return the newest one."""
        messages = self.follow(topic)
        return self.wait(lambda: messages)[-1]

    def more(self, topic, count=1):
        """Follow a topic, wait for this number of further messages, and return them."""
        messages = self.follow(topic)
        self.catch_up()
        begin = len(messages)
        self.wait(lambda: len(messages) >= begin + count)
        return messages[begin:begin + count]

    def status(self, topic, **wanted):
        """Follow a latched status until it has some values, and return all of them."""
        received = self.follow(topic, kind=DiagnosticStatus, qos=LATCHED)
        self.catch_up()
        self.wait(lambda: received and wanted.items() <= values_of(received[-1]).items(),
                  instead=lambda: [values_of(message) for message in received[-3:]])
        return values_of(received[-1])

    def state(self):
        """Return the newest state of the device, None before the first."""
        received = self.follow('device_status', kind=DiagnosticStatus, qos=LATCHED)
        return values_of(received[-1])['state'] if received else None

    def diagnostics(self, node, condition=lambda status: True):
        """Wait for a new status of a node on /diagnostics that fulfils a condition."""
        arrays = self.follow('/diagnostics', kind=DiagnosticArray)
        self.catch_up()
        begin = len(arrays)

        def found():
            return next((status for array in arrays[begin:] for status in array.status
                         if status.name == node and condition(status)), None)
        return self.wait(found)

    def counts(self, node, prefix, fresh=True):
        """Return the counters of a node on /diagnostics whose names begin with a prefix."""
        known = [status for array in self.received.get('/diagnostics', ())
                 for status in array.status if status.name == node]
        status = self.diagnostics(node) if fresh or not known else known[-1]
        return {key[len(prefix):]: int(value) for key, value in values_of(status).items()
                if key.startswith(prefix)}

    def call(self, kind, service, request):
        """
        Call a service and return its response.

        Each service keeps its client. A server drops its response to a client that it has not
        discovered yet, and a client is ready before that (ros2/rmw_fastrtps, issue 842). So a
        client repeats its request until the first response.
        """
        unknown = service not in self._clients
        client = self._clients.get(service) or self.node.create_client(kind, service)
        self.wait(client.service_is_ready)

        def ask():
            future, end = client.call_async(request), CLOCK.now() + RETRY_INTERVAL_S
            self.wait(lambda: future.done() or (unknown and CLOCK.now() > end))
            return future if future.done() else None
        future = self.wait(ask)
        self._clients[service] = client
        return future.result()

    def arm(self, wanted=True):
        """Request the device to arm or disarm."""
        return self.call(SetBool, 'arm', SetBool.Request(data=wanted))

    def trigger(self, service):
        """Call a service without arguments."""
        return self.call(Trigger, service, Trigger.Request())

    def publisher(self, kind, topic, qos=COMMAND):
        """Make a publisher and wait for its first subscriber."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.wait(publisher.get_subscription_count)
        return publisher

    def drive(self, torques):
        """Answer every tick with these torques [N m] from now on; None ends the answers."""
        self._torques = torques
        if self._driving is None:
            self._driving = self.publisher(JointState, 'flywheel_command')
            self.node.create_subscription(JointState, 'flywheel_states', self._answer, DEEP)
            self.wait(lambda: self.node.count_publishers(
                self.node.resolve_topic_name('flywheel_states')))

    def command(self, stamp_ns, names=FLYWHEEL_NAMES, **fields):
        """Send one wheel command."""
        self._driving.publish(set_stamp(JointState(name=list(names), **fields), stamp_ns))

    def _answer(self, tick):
        if self._torques is not None:
            self.command(stamp_of(tick), effort=self._torques)

    def setpoint_decision(self, message, publisher):
        """Send a setpoint and return the values of controller_status after the decision."""
        before = self.status('controller_status')
        publisher.publish(message)
        received = self.received['controller_status']

        def decided():
            now = values_of(received[-1])
            return now if any(now[key] != before[key] for key in ('accepted', 'refused')) else None
        return self.wait(decided)


@pytest.fixture(scope='session')
def load_clock():
    """Return the clock of the deadlines."""
    return CLOCK


@pytest.fixture(scope='session')
def compiled():
    """Compile the kernels before nodes have to answer in time."""
    warm_up()


@pytest.fixture(scope='session')
def fork_server(compiled):
    """Fork processes that need no fresh interpreter."""
    fork_server = _fork_server.ForkServer()
    yield fork_server
    fork_server.close()


@pytest.fixture(scope='module')
def domain(compiled):
    """Claim a domain for the module, and set it in the environment of the processes."""
    with claimed_domain() as number, pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(number))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE',
                     str(share_directory() / 'config' / 'fastdds_loopback.xml'))
        yield number


@pytest.fixture(scope='module')
def shared_memory(domain):
    """Check after the end of all processes that they left no file in /dev/shm."""
    shared_memory = SharedMemory()
    yield shared_memory
    if shared_memory.spoiled:
        spoiled_domains.add(domain)
    shared_memory.check()


@pytest.fixture(scope='module')
def module_suite(shared_memory, fork_server, tmp_path_factory):
    """Run processes until the end of the module."""
    suite = Suite(tmp_path_factory.mktemp('module'), shared_memory, fork_server)
    yield suite
    suite.close()


@pytest.fixture
def suite(shared_memory, fork_server, tmp_path):
    """Run processes until the end of the test."""
    suite = Suite(tmp_path, shared_memory, fork_server)
    yield suite
    suite.close()


@pytest.fixture(scope='module')
def make_probe(domain, shared_memory):
    """Return a function that makes a probe; its attribute `probes` lists those of the module."""
    probes = []
    # A full garbage collection of all modules that pytest imports outlasts a command timeout.
    gc.collect()
    gc.freeze()

    def make(namespace=''):
        probes.append(Probe(domain, namespace))
        return probes[-1]
    make.probes = probes
    yield make
    shared_memory.note(os.getpid())
    for probe in probes:
        probe.close()


@pytest.fixture(scope='module')
def probe(make_probe):
    """Watch the nodes of the module."""
    return make_probe()
