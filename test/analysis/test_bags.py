# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Bags are read with all their values, or refused in one line with the reason."""

from fourbar_ros.analysis.bag_reader import BagError
from fourbar_ros.analysis.bags import JointSeries, read_bag
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

LINKS = ('link_a', 'link_b', 'link_c', 'link_d')


@pytest.mark.parametrize('storage', list(StoragePlugin), ids=lambda plugin: plugin.name)
def test_values_are_read_exactly(synthetic, tmp_path, storage):
    values = np.random.default_rng(1).standard_normal((20, 3, 4))
    stamps = 10**18 + np.arange(20) * 4_000_001  # beyond the precision of a float
    bag = synthetic.write_bag(tmp_path / 'bag', {'/reference': [
        (row, synthetic.joint_state(stamps[row], LINKS, *values[row])) for row in range(20)]},
        storage)

    series = read_bag(bag).joint_states('reference')

    assert series.names == LINKS
    assert np.array_equal(series.stamp_ns, stamps)
    for index, array in enumerate((series.position, series.velocity, series.effort)):
        assert np.array_equal(array, values[:, index])


def test_missing_fields_are_nan(synthetic, tmp_path):
    bag = synthetic.write_bag(tmp_path / 'bag', {'/link_angles': [
        (1, synthetic.joint_state(1, ['link_b', 'link_d'], [2.0, 4.0])),
        (2, synthetic.joint_state(2, [], [])),
        (3, synthetic.joint_state(3, ['link_a', 'link_b'], [1.0]))]})

    series = read_bag(bag).joint_states('link_angles').select(LINKS)

    nan = np.nan
    assert np.array_equal(
        series.position, [[nan, 2.0, nan, 4.0], [nan] * 4, [nan] * 4], equal_nan=True)
    assert np.all(np.isnan(series.velocity))


def test_stamps_are_unique_and_in_order_with_the_first_message(synthetic, tmp_path):
    bag = synthetic.write_bag(tmp_path / 'bag', {'/reference': [
        (received, synthetic.joint_state(stamp, ['link_a'], [received]))
        for received, stamp in enumerate([30, 10, 20, 10, 30])]})
    recording = read_bag(bag)

    series = recording.joint_states('reference')

    assert series.stamp_ns.tolist() == [10, 20, 30]
    assert series.position[:, 0].tolist() == [1, 2, 0]
    assert len(recording.arrivals('reference')) == 5


@pytest.fixture
def recording_of(synthetic, tmp_path):
    """Return a function that makes a recording with one message on each of some topics."""
    def make(*topics, namespace=None):
        bag = synthetic.write_bag(tmp_path / 'bag', {
            topic: [(0, synthetic.joint_state(0, [topic], [1.0]))] for topic in topics})
        return read_bag(bag, namespace)
    return make


def test_namespace_is_found(recording_of):
    recording = recording_of('/lab/reference', '/lab/sim/flywheel_states', '/lab/flywheel_states')
    assert recording.joint_states('reference').topic == '/lab/reference'
    assert recording.joint_states('flywheel_states').topic == '/lab/flywheel_states'
    assert recording.joint_states('sim/flywheel_states').topic == '/lab/sim/flywheel_states'


def test_ground_truth_never_replaces_a_measurement(recording_of):
    recording = recording_of('/sim/flywheel_states')
    assert not recording.has('flywheel_states')


def test_two_suites_need_a_namespace(recording_of, refuses):
    recording = recording_of('/one/reference', '/two/reference')
    for read in (recording.has, recording.joint_states):
        with refuses(BagError, reason='ambiguous', value=['/one/reference', '/two/reference']):
            read('reference')


@pytest.mark.parametrize('namespace', ['/two', 'two', '/two/'])
def test_namespace_chooses_a_suite(recording_of, namespace):
    recording = recording_of('/one/reference', '/two/reference', namespace=namespace)
    assert recording.joint_states('reference').topic == '/two/reference'


@pytest.mark.medium
def test_status_values(motion_bag, refuses):
    recording = read_bag(motion_bag)
    assert recording.statuses('device_status')[0]['mechanism'] == 'paper'
    with refuses(BagError, reason='type', topic='/device_status',
                 value='diagnostic_msgs/msg/DiagnosticStatus'):
        recording.joint_states('device_status')


def test_absent_and_empty_topics_are_distinguished(synthetic, tmp_path, refuses):
    recording = read_bag(synthetic.write_bag(tmp_path / 'bag', {'/timing': []}))
    assert not recording.has('timing')
    with refuses(BagError, reason='no_message', topic='/timing'):
        recording.joint_states('timing')
    with refuses(BagError, reason='no_topic', topic='energy'):
        recording.joint_states('energy')


@pytest.fixture
def refused(refuses):
    """Return a function that expects an error of read_bag, with the path in its message."""
    def read(path, reason, **values):
        with refuses(BagError, reason=reason, path=str(path), **values) as caught:
            read_bag(path)
        assert str(path) in str(caught.value)
    return read


def test_a_path_without_a_bag_is_refused(refused, tmp_path):
    (tmp_path / 'file').touch()
    refused(tmp_path / 'nowhere', 'missing')
    refused(tmp_path / 'file', 'not_a_bag')
    refused(tmp_path, 'not_a_bag')


def test_error_for_a_bag_of_a_killed_recorder_has_the_repair(synthetic, refused, tmp_path):
    bag = synthetic.write_bag(tmp_path / 'bag', {'/timing': []})
    (bag / 'metadata.yaml').unlink()
    refused(bag, 'no_metadata', repair=f'ros2 bag reindex -s mcap {bag}')


@pytest.mark.medium
def test_bag_cut_anywhere_is_refused(synthetic, refused, tmp_path):
    bag = synthetic.write_bag(tmp_path / 'bag', {'/reference': [
        (row, synthetic.joint_state(row, LINKS, [1.0] * 4)) for row in range(5000)]})
    file = next(bag.glob('*.mcap'))
    content = file.read_bytes()
    for share in (0.0, 0.01, 0.3, 0.6, 0.9, 0.999):
        file.write_bytes(content[:int(share * len(content))])
        refused(bag, 'damaged')


def test_missing_storage_file_is_one_line(synthetic, refused, tmp_path):
    bag = synthetic.write_bag(tmp_path / 'bag', {'/timing': []})
    next(bag.glob('*.mcap')).unlink()
    refused(bag, 'damaged')


@pytest.mark.parametrize('text', ['', 'nonsense: [', 'rosbag2_bagfile_information: {}'])
def test_broken_metadata_is_one_line(synthetic, refused, tmp_path, text):
    bag = synthetic.write_bag(tmp_path / 'bag', {'/timing': []})
    (bag / 'metadata.yaml').write_text(text)
    refused(bag, 'damaged')


def test_values_between_messages_are_interpolated_also_over_a_turn():
    stamps = np.array([0, 4, 8, 12, 40, 44]) * 1_000_000 + 1_700_000_000_000_000_000
    angles = np.array([3.1, 3.14, -3.1032, -3.0632, 0.0, 0.1])[:, None]
    series = JointSeries('/a', stamps, stamps, ('link_a',), angles, angles, angles)
    wanted = stamps[0] + np.array([-1, 0, 1, 6, 20, 42, 44, 45]) * 1_000_000
    found = series.interpolated(wanted)
    # There is no value before, after, at the first message, and in a gap.
    assert (found.stamp_ns - stamps[0]).tolist() == [1_000_000, 6_000_000, 42_000_000, 44_000_000]
    assert found.position[:2, 0] == pytest.approx([3.11, 3.16], abs=1e-4)
    assert np.remainder(found.position[2:, 0], 2 * np.pi) == pytest.approx([0.05, 0.1])
    assert found.velocity[1, 0] == pytest.approx(0.0184, abs=1e-9)
