# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Replay of the estimator over a bag, and comparison with the recorded estimates."""

from dataclasses import asdict
import sqlite3

from fourbar_ros.analysis.bag_reader import BagError
from fourbar_ros.analysis.bags import read_bag
from fourbar_ros.analysis.replay import replay, ReplayError
from fourbar_ros.analysis.replay_comparison import as_json, as_text, compare
from fourbar_ros.analysis.replay_figure import comparison_figure
from fourbar_ros.common.config_files import ConfigurationError
from fourbar_ros.common.settings import SettingError
from fourbar_ros.loop import load_scenario
from fourbar_ros.plotting.style import render
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin, Writer

pytestmark = pytest.mark.medium

# Settings of the recorded run.
OWN = asdict(load_scenario('prototype').estimator)
LINKS = ('link_a', 'link_b', 'link_c', 'link_d')
ESTIMATES = ('link_states', 'sigma', 'covariance', 'disturbance', 'decisions', 'innovation')
KINDS = (('angle_rms_rad', 'angle_max_rad'), ('rate_rms_rad_s', 'rate_max_rad_s'))


def stored(bag, topics=None):
    """Return (topic, type, log time, bytes) of all messages, or of some topics."""
    with Reader(bag) as reader:
        return [(connection.topic, connection.msgtype, logged, bytes(data))
                for connection, logged, data in reader.messages()
                if topics is None or connection.topic in topics]


def numbers(bag, replayed_to, **values):
    """Replay and return the numbers of the comparison."""
    return as_json(compare(replay(bag, replayed_to, {**OWN, **values}), 0.5))


def changed(messages, topic, change):
    """Return messages with those of one topic replaced by change(index, message)."""
    entries = []
    for index, (logged, message) in enumerate(messages[topic]):
        entries += [(logged, new) for new in change(index, message)]
    return {**messages, topic: entries}


@pytest.fixture(scope='module')
def same(loop_bag, tmp_path_factory):
    """Return a replay with the settings of the run, and its bag."""
    output = tmp_path_factory.mktemp('replay') / 'new'
    return replay(loop_bag, output, OWN), output


# The new bag

def test_same_settings_give_the_same_estimates_bit_for_bit(synthetic, loop_bag, same):
    topics = [f'/estimate/{name}' for name in ESTIMATES]
    old, new = ([(topic, synthetic.STORE.deserialize_cdr(data, kind))
                 for topic, kind, _, data in stored(bag, topics)] for bag in (loop_bag, same[1]))
    assert len(old) > 1500
    for (topic, left), (_, right) in zip(old, new, strict=True):
        assert (topic, left.header.stamp, left.name) == (topic, right.header.stamp, right.name)
        for field in ('position', 'velocity', 'effort'):
            assert getattr(left, field).tobytes() == getattr(right, field).tobytes()
    assert compare(same[0]).identical


def test_other_topics_are_copied_unchanged(loop_bag, same):
    others = {'/device_status', '/link_angles', '/flywheel_states', '/sim/link_states'}
    assert stored(loop_bag, others) == stored(same[1], others)
    assert {topic for topic, *_ in stored(same[1])} <= {
        *others, *(f'/estimate/{name}' for name in (*ESTIMATES, 'waiting'))}


def test_estimates_have_stamp_and_log_time_of_their_ticks(same):
    ticks = read_bag(same[1]).arrivals('flywheel_states')
    states = read_bag(same[1]).arrivals('estimate/link_states')
    assert np.array_equal(ticks.stamp_ns[-len(states):], states.stamp_ns)
    assert np.array_equal(ticks.received_ns[-len(states):], states.received_ns)


def test_ticks_without_estimate_are_counted(same):
    found, bag = same
    waiting = stored(bag, ['/estimate/waiting'])
    assert len(waiting) == found.waiting > 0
    assert {kind for _, kind, _, _ in waiting} == {'std_msgs/msg/Header'}


def test_frame_is_that_of_the_node(synthetic, same):
    _, kind, _, data = stored(same[1], ['/estimate/link_states'])[0]
    assert synthetic.STORE.deserialize_cdr(data, kind).header.frame_id == 'table'


def test_same_bag_and_settings_give_the_same_bytes(loop_bag, tmp_path):
    values = {**OWN, 'angle_noise': 0.004}
    for folder in ('one', 'two'):
        replay(loop_bag, tmp_path / folder / 'new', values)
    for name in ('new.mcap', 'metadata.yaml'):
        assert (tmp_path / 'one' / 'new' / name).read_bytes() == (
            tmp_path / 'two' / 'new' / name).read_bytes()


@pytest.mark.parametrize('how', [
    {'compression': CompressionMode.MESSAGE, 'version': 8},
    {'compression': CompressionMode.FILE, 'storage': StoragePlugin.SQLITE3}], ids=str)
def test_storage_has_no_effect(synthetic, loop_messages, same, tmp_path, how):
    bag = synthetic.write_bag(tmp_path / 'bag', loop_messages, **how)
    replay(bag, tmp_path / 'new', OWN)
    assert stored(tmp_path / 'new') == stored(same[1])


@pytest.mark.parametrize('storage', list(StoragePlugin), ids=lambda plugin: plugin.name)
def test_single_file_suffices(synthetic, loop_messages, same, tmp_path, storage):
    bag = synthetic.write_bag(tmp_path / 'bag', loop_messages, storage)
    file, = [path for path in bag.iterdir() if path.name != 'metadata.yaml']
    replay(file, tmp_path / 'new', OWN)
    assert stored(tmp_path / 'new') == stored(same[1])


def test_bag_of_an_older_recorder(synthetic, loop_messages, same, tmp_path):
    """A bag in SQLite before Iron has no definitions, no hashes, and another version."""
    from ruamel.yaml import YAML
    bag = synthetic.write_bag(tmp_path / 'bag', loop_messages, StoragePlugin.SQLITE3, version=8)
    with sqlite3.connect(bag / 'bag.db3') as base:
        base.executescript(
            'DROP TABLE message_definitions; DROP TABLE schema; DROP TABLE metadata;'
            'ALTER TABLE topics DROP COLUMN type_description_hash;')
    yaml = YAML(typ='safe')
    metadata = yaml.load((bag / 'metadata.yaml').read_text())
    information = metadata['rosbag2_bagfile_information']
    information['version'] = 5
    for key in ('custom_data', 'ros_distro'):
        del information[key]
    for topic in information['topics_with_message_count']:
        del topic['topic_metadata']['type_description_hash']
    with (bag / 'metadata.yaml').open('w') as file:
        yaml.dump(metadata, file)
    replay(bag, tmp_path / 'new', OWN)
    assert stored(tmp_path / 'new') == stored(same[1])


def test_messages_of_unknown_types_are_copied_with_their_definitions(
        synthetic, loop_bag, tmp_path):
    text, digest = 'uint8 level\n', 'RIHS01_' + 'ab' * 32
    odd = [('/odd', 'lab_msgs/msg/Odd', text, digest), ('/bare', 'lab_msgs/msg/Bare', '', '')]
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        made = {}
        for topic, kind, definition, known in odd:
            made[topic] = writer.add_connection(
                topic, kind, msgdef=definition, rihs01=known or 'none')
        for topic, kind, logged, data in stored(loop_bag):
            if topic not in made:
                made[topic] = writer.add_connection(topic, kind, typestore=synthetic.STORE)
            writer.write(made[topic], logged, data)
            if topic == '/flywheel_states':
                for other, *_ in odd:
                    writer.write(made[other], logged, b'\0\1\0\0\7')
    replay(tmp_path / 'bag', tmp_path / 'new', OWN)
    topics = {topic for topic, *_ in odd}
    assert stored(tmp_path / 'bag', topics) == stored(tmp_path / 'new', topics) != []
    with Reader(tmp_path / 'new') as reader:
        found = {connection.topic: connection for connection in reader.connections}
    assert found['/odd'].msgdef.data == text
    assert found['/odd'].digest == digest


# Suites and settings

@pytest.mark.slow
def test_namespace_selects_one_of_two_suites(
        synthetic, loop_messages, same, refuses, tmp_path):
    both = {f'{space}{topic}': entries for space in ('/table1', '/lab/table2')
            for topic, entries in loop_messages.items()}
    bag = synthetic.write_bag(tmp_path / 'bag', both)
    suites = ['/lab/table2', '/table1']
    with refuses(BagError, reason='ambiguous', value=suites):
        replay(bag, tmp_path / 'none', {})
    with refuses(BagError, reason='no_topic', topic='/table3', value=suites):
        replay(bag, tmp_path / 'none', {}, namespace='table3')
    found = replay(bag, tmp_path / 'new', OWN, namespace='table1')
    assert found.namespace == '/table1'
    assert compare(found).identical
    assert [entry[2:] for entry in stored(tmp_path / 'new', ['/table1/estimate/link_states'])] == [
        entry[2:] for entry in stored(same[1], ['/estimate/link_states'])]
    other = ['/lab/table2/estimate/link_states', '/lab/table2/link_angles']
    assert stored(bag, other) == stored(tmp_path / 'new', other)


@pytest.mark.slow
def test_only_suite_is_found_in_its_namespace(synthetic, loop_messages, tmp_path):
    bag = synthetic.write_bag(tmp_path / 'bag', {
        f'/lab{topic}': entries for topic, entries in loop_messages.items()})
    assert replay(bag, tmp_path / 'new', OWN).namespace == '/lab'


def test_mechanism_is_that_of_the_device_unless_it_is_given(loop_bag, same, tmp_path):
    assert same[0].mechanism == 'prototype'
    found = replay(loop_bag, tmp_path / 'new', {**OWN, 'mechanism': 'paper'})
    assert found.mechanism == 'paper'
    assert not compare(found).identical


@pytest.mark.slow
def test_settings_have_an_effect(loop_bag, tmp_path):
    """With ten times the assumed noise, the NIS is a hundred times smaller."""
    found = numbers(loop_bag, tmp_path / 'new', angle_noise=0.017453, counts_per_turn=0)
    assert found['settings']['angle_noise'] == 0.017453
    nis = found['nis_per_degree_of_freedom']
    assert 0.005 < nis['replayed'] / nis['recorded'] < 0.02
    assert not found['identical']


@pytest.mark.parametrize(('values', 'kind', 'expected'), [
    ({'angle_nose': 1.0}, ReplayError, {'unknown': ['angle_nose']}),
    ({'angle_noise': 0.0}, SettingError, {'name': 'angle_noise', 'limit': (1e-9, 1.0)}),
    ({'angle_noise': float('nan')}, SettingError, {'name': 'angle_noise'}),
    ({'counts_per_turn': 0.5}, SettingError, {'name': 'counts_per_turn', 'limit': int}),
    ({'gate_probability': True}, SettingError, {'name': 'gate_probability', 'limit': float}),
    ({'mechanism': 'papre'}, ConfigurationError, {})])
def test_bad_settings_are_refused(loop_bag, refuses, tmp_path, values, kind, expected):
    with refuses(kind, **expected):
        replay(loop_bag, tmp_path / 'new', values)
    assert not (tmp_path / 'new').exists()


# The comparison

def test_differences_are_the_changes_of_the_recorded_estimate(
        synthetic, loop_messages, tmp_path):
    """The change is constant, so it is rms and largest difference; a whole turn is none."""
    angles, rates = np.array([0.01, -0.02, 0.03, 2 * np.pi]), np.array([0.1, 0.2, -0.3, 0.0])

    def moved(_, message):
        stamp = message.header.stamp
        return [synthetic.joint_state(
            stamp.sec * 10**9 + stamp.nanosec, message.name, message.position + angles,
            message.velocity + rates)]

    bag = synthetic.write_bag(
        tmp_path / 'bag', changed(loop_messages, '/estimate/link_states', moved))
    found = numbers(bag, tmp_path / 'new')
    assert not found['identical']
    by = np.stack([angles, rates])
    by[0, 3] = 0.0
    for link, name in enumerate(LINKS):
        for amount, keys in zip(by[:, link], KINDS):
            for key in keys:
                assert found['replayed_minus_recorded'][name][key] == pytest.approx(
                    abs(amount), abs=1e-12)
        # Comparison with the truth shows which of the two is changed.
        key = 'rate_rms_rad_s'
        assert found['recorded_minus_truth'][name][key] >= 0.9 * abs(rates[link])
        assert found['replayed_minus_truth'][name][key] < 0.05


def test_difference_before_both_estimates_have_settled_does_not_count(
        synthetic, loop_messages, tmp_path):
    """The comparison starts after the start of a recorded estimator that is a second late."""
    late = {topic: entries[100:] if topic.startswith('/estimate/') else entries
            for topic, entries in loop_messages.items()}
    bag = synthetic.write_bag(tmp_path / 'bag', late)
    comparison = compare(replay(bag, tmp_path / 'new', OWN), 0.5)
    stamps = read_bag(bag).joint_states('estimate/link_states').stamp_ns
    assert comparison.from_ns == stamps[0] + 500_000_000
    assert as_json(comparison)['replayed_minus_recorded']['samples'] == len(stamps) - 125


def test_bag_without_estimates_and_truth_has_fewer_comparisons(synthetic, loop_messages, tmp_path):
    bare = {topic: loop_messages[topic] for topic in ('/link_angles', '/flywheel_states')}
    bag = synthetic.write_bag(tmp_path / 'bag', bare)
    comparison = compare(replay(bag, tmp_path / 'new', {**OWN, 'mechanism': 'prototype'}))
    found = as_json(comparison)
    assert [name for name, _ in comparison.differences()] == []
    assert found['identical'] is found['recorded'] is found['replayed_minus_truth'] is None
    assert found['nis_per_degree_of_freedom']['recorded'] is None
    assert found['nis_per_degree_of_freedom']['replayed'] == pytest.approx(1.0, abs=0.2)
    assert 'estimates' in as_text(comparison)
    assert render(lambda: comparison_figure(comparison), 'png').startswith(b'\x89PNG')


def test_unusable_messages_are_counted_and_have_no_effect(synthetic, loop_messages, tmp_path):
    def spoilt(index, message):
        bad = {100: ([*LINKS[:3], 'link_x'], [0.0] * 4), 200: (LINKS, [np.nan] * 4),
               300: (LINKS, [0.0])}
        return [message, *([synthetic.joint_state(10**9, *bad[index])] if index in bad else [])]

    def backwards(index, message):
        return [message, *([synthetic.joint_state(1_100_000_000, synthetic.WHEELS, (), [0.0] * 4)]
                           if index == 250 else [])]

    messages = changed(changed(loop_messages, '/link_angles', spoilt),
                       '/flywheel_states', backwards)
    found = numbers(synthetic.write_bag(tmp_path / 'bag', messages), tmp_path / 'new')
    assert found['replayed']['rejected'] == {'names': 1, 'finite': 1, 'length': 1, 'stamp': 1}
    # They have no effect on the estimates.
    assert found['identical']


def test_repeated_tick_is_answered_again(synthetic, loop_messages, tmp_path):
    messages = changed(loop_messages, '/flywheel_states',
                       lambda index, message: [message] * (2 if index == 300 else 1))
    found = replay(synthetic.write_bag(tmp_path / 'bag', messages), tmp_path / 'new', OWN)
    assert compare(found).identical
    states = read_bag(tmp_path / 'new').arrivals('estimate/link_states')
    assert np.sum(np.diff(states.stamp_ns) == 0) == 1


def test_gated_samples_and_faults_are_counted(synthetic, loop_messages, tmp_path):
    """Link c has an error of 0.1 rad for half a second; the recorded faults differ."""
    def off(index, message):
        if not 200 <= index < 325 or 'link_c' not in message.name:
            return [message]
        stamp = message.header.stamp
        return [synthetic.joint_state(
            stamp.sec * 10**9 + stamp.nanosec, message.name,
            message.position + 0.1 * (np.array(message.name) == 'link_c'))]

    messages = changed(loop_messages, '/link_angles', off)
    types = synthetic.STORE.types
    said = synthetic.status(starts='3', sensor_faults='link_a: no data', gated_link_b='7',
                            rejected_late='2')
    said.name = 'estimator'
    header = synthetic.joint_state(0, ()).header
    logged = messages['/flywheel_states'][-1][0]
    messages['/diagnostics'] = [(logged, types['diagnostic_msgs/msg/DiagnosticArray'](
        header=header, status=[synthetic.status(starts='9'), said]))]
    comparison = compare(
        replay(synthetic.write_bag(tmp_path / 'bag', messages), tmp_path / 'new', OWN))
    found = as_json(comparison)
    assert found['recorded'] == {'starts': 3, 'rejected': {'late': 2}, 'gated': {'link_b': 7},
                                 'faults': {'link_a: no data': None}}
    assert 100 < found['replayed']['gated']['link_c'] <= 125
    assert 0.3 < found['replayed']['faults']['link_c: samples far off'] < 1.0
    text = as_text(comparison)
    for word in ('link_c: samples far off', 'link_a: no data', 'gated samples'):
        assert word in text


def test_replay_without_an_estimate_has_a_reason(
        synthetic, loop_messages, refuses, tmp_path):
    messages = changed(loop_messages, '/link_angles',
                       lambda _, message: [synthetic.joint_state(10**9, ['link_x'], [0.0])])
    found = replay(synthetic.write_bag(tmp_path / 'bag', messages), tmp_path / 'new', OWN)
    with refuses(ReplayError, reason='no_estimate') as caught:
        compare(found)
    assert caught.value.values['rejected']['names'] > 0


def test_skip_beyond_the_end_is_refused(same, refuses):
    with refuses(ReplayError, reason='skip', value=100.0):
        compare(same[0], 100.0)


# Refused bags

@pytest.fixture
def refused(refuses, tmp_path):
    """Return a function that expects an error of replay, with the path in its message."""
    def run(bag, reason, **values):
        with refuses(BagError, reason=reason, path=str(bag), **values) as caught:
            replay(bag, tmp_path / 'new', OWN)
        assert not (tmp_path / 'new').exists()
        assert str(bag) in str(caught.value)
        return str(caught.value)
    return run


def test_a_path_without_a_bag_is_refused(refused, tmp_path):
    refused(tmp_path / 'nowhere', 'missing')
    (tmp_path / 'notes.txt').write_text('x')
    refused(tmp_path / 'notes.txt', 'not_a_bag')
    refused(tmp_path, 'not_a_bag')
    for name in ('false.mcap', 'false.db3'):
        (tmp_path / name).write_text('x' * 100)
        refused(tmp_path / name, 'damaged')


def test_error_for_a_bag_of_a_killed_recorder_has_the_repair(loop_bag, refused, tmp_path):
    bag = tmp_path / 'killed'
    bag.mkdir()
    (bag / 'killed.mcap').write_bytes(next(loop_bag.glob('*.mcap')).read_bytes())
    refused(bag, 'no_metadata', repair=f'ros2 bag reindex -s mcap {bag}')


def test_empty_bag_is_refused(synthetic, refused, tmp_path):
    bag = synthetic.write_bag(tmp_path / 'bag', {'/flywheel_states': [], '/link_angles': []})
    refused(bag, 'no_message', topic='/link_angles')


@pytest.mark.parametrize('missing', ['/link_angles', '/flywheel_states'])
def test_present_topics_are_listed_where_one_is_missing(
        synthetic, loop_messages, refused, tmp_path, missing):
    less = {topic: entries[:5] for topic, entries in loop_messages.items() if topic != missing}
    message = refused(synthetic.write_bag(tmp_path / 'bag', less), 'no_topic', topic=missing)
    for topic in less:
        assert topic in message
    silent = {**less, missing: []}
    refused(synthetic.write_bag(tmp_path / 'silent', silent), 'no_message', topic=missing)


@pytest.mark.parametrize('topic', ['/link_angles', '/flywheel_states', '/sim/link_states'])
def test_wrong_type_is_named(synthetic, loop_messages, refused, tmp_path, topic):
    wrong = {**{name: entries[:5] for name, entries in loop_messages.items()},
             topic: [(1, synthetic.status(state='armed'))]}
    refused(synthetic.write_bag(tmp_path / 'bag', wrong), 'type', topic=topic,
            value='diagnostic_msgs/msg/DiagnosticStatus')


def test_single_file_cut_anywhere_is_refused(loop_bag, refused, tmp_path):
    content = next(loop_bag.glob('*.mcap')).read_bytes()
    file = tmp_path / 'cut.mcap'
    for share in (0.0, 0.01, 0.5, 0.999):
        file.write_bytes(content[:int(share * len(content))])
        refused(file, 'damaged')


def test_bag_that_lost_messages_is_refused(synthetic, loop_messages, refuses, tmp_path):
    """The metadata of the bag states more messages."""
    bag = synthetic.write_bag(tmp_path / 'bag', loop_messages, StoragePlugin.SQLITE3)
    with sqlite3.connect(bag / 'bag.db3') as base:
        base.execute('DELETE FROM messages WHERE id > 1500')
    with refuses(BagError, reason='damaged', value=1500):
        replay(bag, tmp_path / 'new', OWN)
