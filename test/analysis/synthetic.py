# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags of a motion with known values of all metrics.

Links a and b of a rhombus (c = a, d = b) turn by `TURN_RAD` in 10 s. The reference is a quintic;
truth, estimate and wheels differ from it by sines with whole periods in the step, so that root
mean squares are amplitude / sqrt(2) and nothing else.
"""

from fourbar_ros.loop import make_loop, run_scenario
from fourbar_ros.mechanism import SENSOR_NAMES
import numpy as np
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

LINKS = ('link_a', 'link_b', 'link_c', 'link_d')
WHEELS = ('flywheel_a', 'flywheel_b', 'flywheel_c', 'flywheel_d')
STATES = ('phi_a', 'phi_b', 'omega_a', 'omega_b')
JOINT_STATE = 'sensor_msgs/msg/JointState'
STATUS = 'diagnostic_msgs/msg/DiagnosticStatus'
STORE = get_typestore(Stores.ROS2_JAZZY)

# Simulated time is independent of the clock of the recorder.
START_NS = 3_000_000_000
RECORDER_OFFSET_NS = 1_700_000_000_000_000_000
HOLD_S, STEP_S, AFTER_S = 1.0, 10.0, 2.0
INITIAL_RAD = np.array([0.0, np.pi / 3, 0.0, np.pi / 3])
TURN_RAD = np.pi / 2
TRACKING_RAD = np.array([0.01, 0.02, 0.01, 0.02])
FINAL_RAD = np.array([0.002, -0.005, 0.002, -0.005])
ESTIMATE_RAD = 0.003
SIGMA_RAD = 0.0018
# Absolute wheel speed over link rate: rhombus of the paper, four wheels.
WHEEL_RATIO = -211.76


def joint_state(stamp_ns, names, position=(), velocity=(), effort=()):
    types = STORE.types
    stamp = types['builtin_interfaces/msg/Time'](
        sec=int(stamp_ns // 10**9), nanosec=int(stamp_ns % 10**9))
    return types[JOINT_STATE](
        header=types['std_msgs/msg/Header'](stamp=stamp, frame_id=''), name=list(names),
        position=np.array(position, dtype=float), velocity=np.array(velocity, dtype=float),
        effort=np.array(effort, dtype=float))


def status(**values):
    pairs = [STORE.types['diagnostic_msgs/msg/KeyValue'](key=key, value=value)
             for key, value in values.items()]
    return STORE.types[STATUS](level=0, name='', message='', hardware_id='', values=pairs)


def write_bag(path, messages, storage=StoragePlugin.MCAP, version=9, compression=None):
    """Write {topic: [(received_ns, message), ...]}; an empty list makes an empty topic."""
    writer = Writer(path, version=version, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, entries in messages.items():
            message_type = entries[0][1].__msgtype__ if entries else JOINT_STATE
            connections[topic] = writer.add_connection(topic, message_type, typestore=STORE)
        merged = [(received_ns, topic, message) for topic, entries in messages.items()
                  for received_ns, message in entries]
        for received_ns, topic, message in sorted(merged, key=lambda entry: entry[0]):
            data = STORE.serialize_cdr(message, message.__msgtype__)
            writer.write(connections[topic], received_ns, data)
    return path


def quintic(seconds, duration=STEP_S):
    s = np.clip(seconds / duration, 0.0, 1.0)
    return (10 * s**3 - 15 * s**4 + 6 * s**5,
            (30 * s**2 - 60 * s**3 + 30 * s**4) / duration)


def sine(seconds, periods):
    """Return a unit sine with whole periods in the step, and its rate; zero outside."""
    rate = 2 * np.pi * periods / STEP_S
    inside = (seconds >= 0) & (seconds <= STEP_S)
    return (np.where(inside, np.sin(rate * seconds), 0.0),
            np.where(inside, rate * np.cos(rate * seconds), 0.0))


def signals(rate_hz):
    """Return time since the setpoint (n,) and truth, reference, estimate (n, 4), with rates."""
    ticks = np.arange(round(-HOLD_S * rate_hz), round((STEP_S + AFTER_S) * rate_hz) + 1)
    seconds = ticks / rate_hz
    profile, speed = quintic(seconds)
    error, error_rate = sine(seconds, 4)
    after = np.where(seconds > STEP_S, 1.0, 0.0)
    reference = INITIAL_RAD + TURN_RAD * profile[:, None]
    reference_rate = np.tile(TURN_RAD * speed[:, None], 4)
    truth = reference + TRACKING_RAD * error[:, None] + FINAL_RAD * after[:, None]
    truth_rate = reference_rate + TRACKING_RAD * error_rate[:, None]
    # The error continues after the step, so that its rms is that of a sine for all times.
    estimate = truth + ESTIMATE_RAD * np.sin(2 * np.pi * 3 * seconds)[:, None]
    return {'seconds': seconds, 'reference': (reference, reference_rate),
            'truth': (truth, truth_rate), 'estimate': (estimate, truth_rate)}


def motion_messages(rate_hz=50, namespace='', seed=0, mechanism='paper'):
    """Return the messages of the whole motion, for :func:`write_bag`."""
    rng = np.random.default_rng(seed)
    known = signals(rate_hz)
    truth, truth_rate = known['truth']
    wheels = (WHEEL_RATIO - 1) * truth_rate
    torque = 6.5e-6 * np.sin(2 * np.pi * np.clip(known['seconds'], 0, STEP_S) / STEP_S)
    energy = 2 * 3.4e-7 * (WHEEL_RATIO * truth_rate[:, 0])**2
    topics = {}

    def add(name, received_ns, message):
        topics.setdefault(f'{namespace}/{name}', []).append((received_ns, message))

    begin = RECORDER_OFFSET_NS
    add('device_status', begin, status(state='armed', mechanism=mechanism))
    add('controller_status', begin + 1, status(mode='hold', setpoint_duration_s='10.0'))
    for row, second in enumerate(known['seconds']):
        stamp = START_NS + round(second * 1e9)
        # Log times have another rate than simulated time, and jitter.
        now = begin + 1000 + row * 1_000_000 + int(rng.integers(400_000))
        if second == 0.0:
            add('setpoint', now - 500_000, joint_state(
                0, LINKS[:2], INITIAL_RAD[:2] + TURN_RAD))
        raw = truth[row] + 0.0017 * rng.standard_normal(4)
        seen = rng.random(4) > 0.01
        if seen.any():
            add('link_angles', now, joint_state(
                stamp - 5_000_000, np.array(LINKS)[seen],
                np.angle(np.exp(1j * raw[seen]))))
        add('flywheel_states', now + 1, joint_state(
            stamp, WHEELS, np.zeros(4), wheels[row], np.full(4, torque[row])))
        add('sim/link_states', now + 2, joint_state(stamp, LINKS, truth[row], truth_rate[row]))
        add('sim/flywheel_states', now + 3, joint_state(stamp, WHEELS, np.zeros(4), wheels[row]))
        add('timing', now + 4, timing(stamp, row, rng))
        for name, source in (('estimate/link_states', 'estimate'), ('reference', 'reference')):
            angle, rate = known[source]
            add(name, now + 5, joint_state(stamp, LINKS, angle[row], rate[row]))
        add('estimate/sigma', now + 6, joint_state(
            stamp, LINKS, np.full(4, SIGMA_RAD), np.full(4, 0.01)))
        innovation = 0.0017 * rng.standard_normal(seen.sum())
        add('estimate/innovation', now + 7, joint_state(
            stamp, ['nis', 'degrees_of_freedom', *np.array(LINKS)[seen]],
            [np.sum(innovation**2) / 0.0017**2, seen.sum(), *innovation]))
        difference = known['reference'][0][row] - known['estimate'][0][row]
        add('tracking_error', now + 8, joint_state(stamp, LINKS, difference))
        past = max(second, 0.0)
        add('energy', now + 9, joint_state(
            stamp, ['flywheel_energy_j', 'eq9_j_s', 'work_j', 'copper_loss_j'],
            [energy[row], 2e-3 * past, 5e-4 * past, 3e-4 * past]))
    return topics


def timing(stamp, row, rng):
    """Make one timing message: round trip 1 ms plus noise, one tick in 100 unanswered."""
    names, values = ['round_trip_s', 'command_age_s', 'lost', 'step_s'], [
        1e-3 * rng.lognormal(0, 0.25), 1.2e-3, row // 100, 5e-5]
    if row % 100 == 99:
        del names[:2], values[:2]
    return joint_state(stamp, names, values)


def closed_loop_messages(scenario, namespace=''):
    """
    Return the messages of the nodes in a run, with log times of a recorder.

    The code that makes the messages of the estimator node is not used here.
    """
    topics = {}
    now = RECORDER_OFFSET_NS

    def add(name, message):
        nonlocal now
        now += 10_000
        topics.setdefault(f'{namespace}/{name}', []).append((now, message))

    add('device_status', status(state='disarmed', mechanism=scenario.mechanism_name))
    loop = make_loop(scenario)
    for step in run_scenario(scenario, loop):
        stamp = step.samples.stamp_ns
        for sample in step.samples.links:
            add('link_angles', joint_state(
                sample.stamp_ns, sample.names, sample.angles, sample.rates))
        wheels, truth = step.samples.wheels, step.samples.truth
        add('flywheel_states', joint_state(
            stamp, WHEELS, wheels.angles, wheels.speeds, wheels.efforts))
        add('sim/link_states', joint_state(stamp, LINKS, truth.link_angles, truth.link_rates))
        if (estimate := step.estimate) is None:
            continue
        add('estimate/link_states', joint_state(
            stamp, LINKS, estimate.link_angles, estimate.link_rates,
            [*estimate.disturbance, 0.0, 0.0]))
        add('estimate/sigma', joint_state(
            stamp, LINKS, estimate.angle_sigmas, estimate.rate_sigmas))
        count = len(estimate.covariance)
        add('estimate/covariance', joint_state(
            stamp, [f'{row}.{column}' for n, row in enumerate(STATES) for column in STATES[n:]],
            [estimate.covariance[m, n] for m in range(count) for n in range(m, count)]))
        add('estimate/disturbance', joint_state(
            stamp, ['torque_a', 'torque_b', 'sigma_a', 'sigma_b'],
            [*estimate.disturbance, *estimate.disturbance_sigmas]))
        if decisions := loop.estimator.sample_statuses():
            add('estimate/decisions', joint_state(
                stamp, [SENSOR_NAMES[decision.sensor] for decision in decisions],
                [float(decision.status) for decision in decisions],
                [decision.nis for decision in decisions],
                [float(decision.status == 0) for decision in decisions]))
        if (seen := estimate.innovation) is not None:
            add('estimate/innovation', joint_state(
                stamp, ['nis', 'degrees_of_freedom',
                        *(SENSOR_NAMES[sensor] for sensor in seen.sensors)],
                [seen.nis, np.sum(seen.used), *seen.values]))
    return topics
