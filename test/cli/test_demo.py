# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar demo`: complete, interrupted and refused."""

from importlib.util import module_from_spec, spec_from_file_location
import json
from math import radians
import os
from pathlib import Path
import signal
import time

from fourbar_ros.cli.demo import JOINTS, STATUSES
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores

pytestmark = pytest.mark.node

# Tests are no package: the harness of the node tests is loaded from its file.
_path = Path(__file__).parents[1] / 'ros' / 'conftest.py'
_spec = spec_from_file_location('node_harness', _path)
harness = module_from_spec(_spec)
_spec.loader.exec_module(harness)
compiled, domain, shared_memory = harness.compiled, harness.domain, harness.shared_memory
module_suite, suite, fork_server = harness.module_suite, harness.suite, harness.fork_server

# Time limit of a demo on a busy machine; its motion takes twelve seconds [s].
DEMO_S = 180.0
PEAK_SPEED = 62.37
CHILDREN = {'plant', 'estimator', 'controller', 'record'}


def wait_for(condition, seconds=90.0):
    deadline = time.monotonic() + seconds
    while not (result := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return result


def children(process):
    """Return the ids of the child processes of a process, by the name of the command."""
    found = {}
    for folder in Path('/proc').glob('[0-9]*'):
        try:
            parent = (folder / 'stat').read_text().rpartition(')')[2].split()[1]
            words = (folder / 'cmdline').read_text().split('\0')
        except OSError:     # the process has ended
            continue
        if int(parent) == process.popen.pid and 'fourbar_ros' in words:
            found[words[words.index('fourbar_ros') + 1]] = int(folder.name)
    return found


def runs(pid):
    return Path('/proc', str(pid)).exists()


@pytest.fixture(scope='module')
def both(module_suite, tmp_path_factory):
    """Run one demo to its end, and start another one on the same domain during the first."""
    output = tmp_path_factory.mktemp('demo') / 'out'
    output.mkdir()
    (output / 'notes.txt').write_text("not the demo's")
    first = module_suite.start('demo', '--output', str(output), fresh=True)
    wait_for(lambda: first.popen.poll() is not None or 'Turning' in first.stdout)
    assert first.popen.poll() is None, first.stderr
    started = children(first)
    rival_output = output.parent / 'rival'
    rival = module_suite.start('demo', '--output', str(rival_output), fresh=True)
    rival.end(seconds=60.0)
    first.end(seconds=DEMO_S)
    return {'first': first, 'rival': rival, 'output': output, 'rival_output': rival_output,
            'children': started}


@pytest.fixture(scope='module')
def metrics(both):
    return json.loads((both['output'] / 'metrics.json').read_text())


def test_demo_succeeds_and_prints_the_path_of_the_report(both):
    first, output = both['first'], both['output']
    assert (first.popen.returncode, first.stderr) == (0, '')
    assert first.stdout.splitlines()[-1].split() == ['Report', str(output / 'report.html')]
    assert os.environ['ROS_DOMAIN_ID'] in first.stdout
    assert 'ros2 topic echo' in first.stdout
    assert (output / 'notes.txt').read_text() == "not the demo's"


def test_demo_runs_its_parts_in_their_own_processes(both):
    assert set(both['children']) == CHILDREN
    assert not any(runs(pid) for pid in both['children'].values())
    logs = {path.stem: path.read_text() for path in (both['output'] / 'logs').iterdir()}
    assert set(logs) == CHILDREN
    assert not any('Traceback' in log for log in logs.values())


def test_report_is_one_page(both):
    page = (both['output'] / 'report.html').read_text()
    assert page.startswith('<!DOCTYPE html>')
    assert page.rstrip().endswith('</html>')
    for source in ('src="http', 'href="http'):
        assert source not in page


def test_metrics_are_those_of_a_quarter_turn(metrics):
    half_degree = radians(0.5)
    assert 0.0 < metrics['tracking']['rms_rad'] <= half_degree
    assert 0.0 <= metrics['tracking']['final_error_rad'] <= half_degree
    assert 0.0 < metrics['estimate']['rms_error_rad'] <= radians(0.1)
    assert metrics['flywheel']['peak_speed_rad_s'] == pytest.approx(PEAK_SPEED, rel=0.1)
    # Eq. 7 with four wheels at the peak speed.
    assert metrics['flywheel']['peak_energy_j'] == pytest.approx(
        4 * 0.5 * 3.4e-7 * PEAK_SPEED ** 2, rel=0.2)
    loop = metrics['loop']
    assert loop['rate_hz'] > 0.0
    assert 0.0 < loop['round_trip_p50_ms'] <= loop['round_trip_p99_ms']
    assert loop['lost'] >= 0


def test_table_shows_the_metrics(both, metrics):
    out = both['first'].stdout
    assert 'not recorded' not in out
    assert f'{metrics["flywheel"]["peak_speed_rad_s"]:10.4g} rad/s' in out


def test_bag_is_readable_and_complete(both):
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(both['output'] / 'bag') as reader:
        counts = {name: topic.msgcount for name, topic in reader.topics.items()}
        wanted = {f'/{topic}' for topic in ('setpoint', *STATUSES, *JOINTS)}
        assert wanted | {'/diagnostics'} <= set(counts)
        assert all(counts[topic] for topic in wanted)
        assert counts['/setpoint'] == 1
        # Settling and the motion of ten seconds have one tick every 4 ms.
        assert counts['/flywheel_states'] > 2000
        setpoint, = [
            store.deserialize_cdr(data, connection.msgtype) for connection, _, data
            in reader.messages([c for c in reader.connections if c.topic == '/setpoint'])]
        assert list(setpoint.name) == ['link_a', 'link_b']
        states = [
            {item.key: item.value for item in store.deserialize_cdr(
                data, connection.msgtype).values}['state'] for connection, _, data
            in reader.messages([c for c in reader.connections if c.topic == '/device_status'])]
    assert [*dict.fromkeys(states)] == ['disarmed', 'armed']
    assert states[-1] == 'disarmed'


def test_second_demo_on_the_domain_is_refused_and_has_no_effect(both):
    rival = both['rival']
    assert (rival.popen.returncode, rival.stdout) == (2, '')
    line, = rival.stderr.splitlines()
    assert line.startswith('fourbar demo: ')
    assert f'ROS_DOMAIN_ID {os.environ["ROS_DOMAIN_ID"]}' in line
    assert not both['rival_output'].exists()


@pytest.mark.slow
def test_interrupt_during_the_motion_stops_everything(suite, tmp_path):
    demo = suite.start('demo', '--output', str(tmp_path / 'out'), fresh=True)
    wait_for(lambda: demo.popen.poll() is not None or 'Turning' in demo.stdout)
    started = children(demo)
    assert set(started) == CHILDREN

    code = demo.end(signal.SIGINT, seconds=60.0)

    assert code == 130
    assert demo.stderr == 'fourbar demo: interrupted\n'
    assert not any(runs(pid) for pid in started.values())
    # The bag is readable up to the interrupt.
    with Reader(tmp_path / 'out' / 'bag') as reader:
        assert reader.message_count > 0
    for path in (tmp_path / 'out' / 'logs').iterdir():
        assert 'Traceback' not in path.read_text()


@pytest.mark.slow
def test_parts_end_with_a_demo_that_is_killed(suite, shared_memory, tmp_path):
    demo = suite.start('demo', '--output', str(tmp_path / 'out'), fresh=True)
    wait_for(lambda: set(children(demo)) == CHILDREN or demo.popen.poll() is not None)
    started = children(demo)
    assert set(started) == CHILDREN, demo.stderr

    for pid in started.values():
        shared_memory.note(pid)
    demo.kill()

    wait_for(lambda: not any(runs(pid) for pid in started.values()))


def test_output_that_cannot_be_written_is_refused(suite, tmp_path):
    (tmp_path / 'file').touch()
    demo = suite.start('demo', '--output', str(tmp_path / 'file' / 'out'), fresh=True)
    assert demo.end(seconds=60.0) == 2
    line, = demo.stderr.splitlines()
    assert line.startswith('fourbar demo: cannot write to')
    assert str(tmp_path / 'file') in line
    assert children(demo) == {}
