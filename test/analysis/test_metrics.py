# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Metrics of motions with known values (see synthetic.py)."""

import json

from fourbar_ros.analysis.bag_reader import BagError
from fourbar_ros.analysis.bags import read_bag
from fourbar_ros.analysis.manoeuvre import find_manoeuvre
from fourbar_ros.analysis.metrics import compute_metrics, METRICS
from fourbar_ros.mechanism import Mechanism
import numpy as np
import pytest

FOUR = np.ones(4)
PAPER = Mechanism(
    0.1 * FOUR, 0.02 * FOUR, 2.2e-5 * FOUR, np.tile([0.05, 0.0], (4, 1)), 3.4e-7 * FOUR)


@pytest.fixture(scope='module')
def result(motion_bag):
    return compute_metrics(read_bag(motion_bag), PAPER)


@pytest.fixture
def motion_with(synthetic, tmp_path):
    """Return a function that makes a recording of the motion with changed messages."""
    def make(change, **options):
        messages = synthetic.motion_messages(**options)
        change(messages)
        return read_bag(synthetic.write_bag(tmp_path / 'bag', messages))
    return make


@pytest.mark.medium
def test_every_metric_is_present_and_read_back_from_json(result):
    assert result['missing'] == {}
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert {f'{group}.{key}' for group in result if group not in ('motion', 'missing')
            for key in result[group]} == set(METRICS)


def test_motion_begins_at_the_tick_of_the_setpoint(result, synthetic):
    motion = result['motion']
    assert motion['start_stamp_ns'] == synthetic.START_NS
    assert motion['duration_s'] == synthetic.STEP_S + synthetic.AFTER_S
    assert motion['complete']
    assert list(motion['goal_rad'].values()) == pytest.approx(
        synthetic.INITIAL_RAD + synthetic.TURN_RAD)


def test_tracking_is_that_of_a_sine(result, synthetic):
    amplitudes = synthetic.TRACKING_RAD[:2]
    # The last of 501 samples of whole periods repeats the first, which is zero.
    expected = np.sqrt(np.mean(amplitudes**2) / 2 * 500 / 501)
    assert result['tracking']['rms_rad'] == pytest.approx(expected, rel=1e-9)
    # A sample is within half a sampling period of the peak.
    crest = np.cos(2 * np.pi * 4 / synthetic.STEP_S / 50 / 2)
    assert crest * amplitudes.max() <= result['tracking']['peak_rad'] <= amplitudes.max()


def test_final_error_is_the_mean_of_the_larger_one(result, synthetic):
    expected = np.max(np.abs(synthetic.FINAL_RAD))
    assert result['tracking']['final_error_rad'] == pytest.approx(expected, rel=1e-9)
    # The estimate oscillates by 3 mrad in whole periods a second, with one further sample.
    assert result['tracking']['estimated_final_error_rad'] == pytest.approx(
        expected, abs=synthetic.ESTIMATE_RAD / 51)


def test_estimate_error_is_that_of_a_sine_over_all_time(result, synthetic):
    expected = synthetic.ESTIMATE_RAD * np.sqrt(0.5 * 600 / 601)
    assert result['estimate']['rms_error_rad'] == pytest.approx(expected, rel=1e-6)
    # The sine of 3 mrad is within the band of 3.6 mrad.
    assert result['estimate']['within_2_sigma'] == 1.0


def test_nis_of_noise_as_modelled_is_one(result):
    # 601 ticks of nearly four degrees of freedom: standard deviation sqrt(2 / 2380) = 0.029.
    assert result['estimate']['mean_nis_per_degree_of_freedom'] == pytest.approx(1.0, abs=0.1)


def test_wheels(result, synthetic):
    truth_rate = synthetic.signals(50)['truth'][1]
    absolute = synthetic.WHEEL_RATIO * truth_rate
    assert result['flywheel']['peak_energy_j'] == pytest.approx(
        np.max(np.sum(1.7e-7 * absolute**2, axis=1)))
    assert result['flywheel']['final_energy_j'] == 0.0
    assert result['flywheel']['peak_speed_rad_s'] == pytest.approx(
        np.max(np.abs(absolute - truth_rate)))
    assert result['flywheel']['peak_torque_n_m'] == pytest.approx(6.5e-6, rel=1e-3)


def test_energy_counts_from_the_setpoint(result, synthetic):
    seconds = synthetic.STEP_S + synthetic.AFTER_S
    assert result['energy']['eq9_j_s'] == pytest.approx(2e-3 * seconds)
    assert result['energy']['work_j'] == pytest.approx(5e-4 * seconds)
    assert result['energy']['copper_loss_j'] == pytest.approx(3e-4 * seconds)


def test_loop(result, motion_bag):
    loop = result['loop']
    assert (loop['rate_hz'], loop['ticks'], loop['unrecorded_ticks']) == (50.0, 601, 0)
    assert loop['lost'] == 6
    trips = read_bag(motion_bag).joint_states('timing').select(('round_trip_s',)).position[50:, 0]
    trips = 1e3 * np.sort(trips[np.isfinite(trips)])
    assert len(trips) == 595
    assert trips[296] <= loop['round_trip_p50_ms'] <= trips[298]
    assert trips[587] <= loop['round_trip_p99_ms'] <= trips[589]
    assert loop['round_trip_max_ms'] == trips[-1]


@pytest.mark.medium
def test_namespace_and_recorder_time_have_no_effect(synthetic, tmp_path, result):
    messages = synthetic.motion_messages(namespace='/lab')
    for entries in messages.values():
        entries[:] = [(20 * received_ns % 2**62, message) for received_ns, message in entries]
    other = compute_metrics(read_bag(synthetic.write_bag(tmp_path / 'bag', messages)), PAPER)
    assert other == result


@pytest.mark.medium
def test_whole_turns_between_topics_have_no_effect(motion_with, result):
    def turn(messages):
        for number, name in ((1, '/estimate/link_states'), (-2, '/reference')):
            for _, message in messages[name]:
                message.position += 2 * np.pi * number
    turned = compute_metrics(motion_with(turn), PAPER)
    for group in ('tracking', 'estimate'):
        assert turned[group] == pytest.approx(result[group], rel=1e-9)


@pytest.mark.medium
def test_late_recorder_does_not_shift_the_start(motion_with, synthetic):
    def delay(messages):
        received_ns, setpoint = messages['/setpoint'][0]
        messages['/setpoint'] = [(received_ns + 20_000_000, setpoint)]  # 20 ticks late
    assert find_manoeuvre(motion_with(delay)).start_ns == synthetic.START_NS


@pytest.mark.medium
def test_refused_setpoint_is_not_the_begin_of_the_motion(motion_with, synthetic):
    def refuse(messages):
        received_ns, _ = messages['/setpoint'][0]
        for later, goal in ((1_000_000_000, [1.0, np.nan]), (600_000_000, [-2.0, 1.0])):
            messages['/setpoint'].append(
                (received_ns + later, synthetic.joint_state(0, ['link_a', 'link_b'], goal)))
    motion = find_manoeuvre(motion_with(refuse))
    assert (motion.setpoint_number, motion.setpoint_count) == (1, 3)
    assert motion.start_ns == synthetic.START_NS


@pytest.mark.medium
def test_goal_of_a_link_without_setpoint_is_its_reference(motion_with, synthetic):
    def hold(messages):
        received_ns, _ = messages['/setpoint'][0]
        messages['/setpoint'] = [(received_ns, synthetic.joint_state(
            0, ['link_a'], [synthetic.TURN_RAD]))]
        for _, message in messages['/reference']:
            message.position[[1, 3]] = 1.25
    goal = find_manoeuvre(motion_with(hold)).goal
    assert goal[:2] == pytest.approx([synthetic.TURN_RAD, 1.25])


@pytest.mark.medium
def test_setpoint_at_the_present_angles(motion_with, synthetic):
    def rest(messages):
        received_ns, _ = messages['/setpoint'][0]
        messages['/setpoint'] = [(received_ns, synthetic.joint_state(
            0, ['link_a', 'link_b'], synthetic.INITIAL_RAD[:2]))]
        for _, message in messages['/reference']:
            message.position[:] = synthetic.INITIAL_RAD
            message.velocity[:] = 0.0
    motion = find_manoeuvre(motion_with(rest))
    assert motion.start_ns == synthetic.START_NS


@pytest.mark.medium
def test_disarming_ends_the_motion(motion_with, synthetic):
    disarmed_ns = synthetic.START_NS + 11_500_000_000

    def disarm(messages):
        for _, message in messages['/reference']:
            stamp = message.header.stamp
            if stamp.sec * 10**9 + stamp.nanosec > disarmed_ns:
                message.position += 0.1
    assert find_manoeuvre(motion_with(disarm)).end_ns == disarmed_ns


@pytest.mark.medium
def test_recording_that_ends_early_has_no_final_error(motion_with, synthetic):
    def cut(messages):
        for name, entries in messages.items():
            messages[name] = entries[:300]
    result = compute_metrics(motion_with(cut), PAPER)
    assert not result['motion']['complete']
    assert 'tracking.final_error_rad' in result['missing']
    assert result['tracking']['rms_rad'] > 0


@pytest.mark.slow
@pytest.mark.parametrize(('topic', 'lost'), [
    ('sim/link_states', {'tracking.rms_rad', 'tracking.peak_rad', 'tracking.final_error_rad',
                         'estimate.rms_error_rad', 'estimate.peak_error_rad',
                         'estimate.within_2_sigma', 'flywheel.peak_energy_j',
                         'flywheel.final_energy_j'}),
    ('sim/flywheel_states', {'flywheel.peak_speed_rad_s', 'flywheel.peak_energy_j',
                             'flywheel.final_energy_j'}),
    ('estimate/sigma', {'estimate.within_2_sigma'}),
    ('estimate/innovation', {'estimate.mean_nis_per_degree_of_freedom'}),
    ('timing', {name for name in METRICS if name.startswith('loop.')}),
    ('energy', {name for name in METRICS if name.startswith('energy.')}),
    ('controller_status', set()),
])
def test_missing_optional_topic_removes_its_metrics_only(motion_with, result, topic, lost):
    def leave_out(messages):
        del messages[f'/{topic}']
    poorer = compute_metrics(motion_with(leave_out), PAPER)
    assert set(poorer['missing']) == lost
    for name in set(METRICS) - lost:
        group, key = name.split('.')
        assert poorer[group][key] == result[group][key]


@pytest.mark.medium
def test_recording_without_copper_losses_has_all_other_metrics(motion_with, result):
    def older(messages):
        for _, message in messages['/energy']:
            del message.name[-1]
            message.position = message.position[:-1]
    poorer = compute_metrics(motion_with(older), PAPER)
    assert set(poorer['missing']) == {'energy.copper_loss_j'}
    assert poorer['energy']['work_j'] == result['energy']['work_j']


@pytest.mark.medium
@pytest.mark.parametrize(
    'topic', ['setpoint', 'reference', 'estimate/link_states', 'flywheel_states'])
def test_missing_essential_topic_is_named(motion_with, refuses, topic):
    def leave_out(messages):
        del messages[f'/{topic}']
    with refuses(BagError, reason='no_topic', topic=topic):
        compute_metrics(motion_with(leave_out), PAPER)


@pytest.mark.medium
def test_setpoint_without_response_is_an_error(motion_with, synthetic, refuses):
    rng = np.random.default_rng(3)

    def disarmed(messages):
        for _, message in messages['/reference']:
            message.position[:] = synthetic.INITIAL_RAD + 1e-3 * rng.standard_normal(4)
    with refuses(BagError, reason='no_data', topic='setpoint'):
        compute_metrics(motion_with(disarmed), PAPER)


@pytest.mark.medium
def test_ticks_that_the_recorder_missed_are_counted(motion_with):
    def thin(messages):
        del messages['/timing'][300:303]
    loop = compute_metrics(motion_with(thin), PAPER)['loop']
    assert (loop['unrecorded_ticks'], loop['ticks']) == (3, 598)


def test_without_mechanism_only_the_energy_is_missing(motion_bag):
    missing = compute_metrics(read_bag(motion_bag))['missing']
    assert set(missing) == {'flywheel.peak_energy_j', 'flywheel.final_energy_j'}
