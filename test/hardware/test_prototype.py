# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The prototype on its bus: samples, stamps, clocks, commands."""

import numpy as np
import pytest

# Resolution of the angle sensors, 14 bits [rad].
ANGLE_STEP = 2.0 * np.pi / 2 ** 14


@pytest.mark.medium
def test_samples_are_those_of_the_table(world) -> None:
    world.samples.clear()
    world.run(2.0)
    assert all(samples.complete for samples in world.samples)
    truth = world.wire.emulators[0].samples.truth
    angles = {name: [] for name in world.prototype.sensor_names}
    for samples in world.samples:
        for reading in samples.links:
            angles[reading.names[0]].append(reading.angles[0])
    for link, (name, read) in enumerate(angles.items()):
        # The links are at rest: 0.1 deg of noise, 99 % of 250 samples a second.
        assert 470 <= len(read) <= 505, name
        expected = np.remainder(truth.link_angles[link] + np.pi, 2.0 * np.pi) - np.pi
        assert abs(np.mean(read) - expected) < 5.0 * 1.7453e-3 / np.sqrt(470) + ANGLE_STEP


@pytest.mark.slow
def test_stamps_are_times_of_measurement(world) -> None:
    world.run(4.0)
    world.samples.clear()
    world.run(2.0)
    for samples in world.samples:
        for reading in samples.links:
            # The table measures every 4 ms; the stamp is the time of the measurement.
            off_ns = (reading.stamp_ns - world.stamp_of(0) - 5_000_000_000 + 2_000_000) % 4_000_000
            assert abs(off_ns - 2_000_000) < 100_000
            age_ns = samples.stamp_ns - reading.stamp_ns
            assert 4_000_000 < age_ns < 15_000_000


@pytest.mark.slow
def test_clocks_are_estimated(world) -> None:
    world.run(20.0)
    for link, drift in zip(world.prototype.links, (80e-6, -40e-6, 10e-6, -60e-6)):
        assert link.clock.drift == pytest.approx(drift, abs=5e-6)
        assert link.clock.jitter < 1e-4


@pytest.mark.medium
def test_torque_reaches_the_wheels_and_is_reported(world) -> None:
    world.torque(0.01, 0.01, 0.01, 0.01)
    assert world.arm() == (True, 'armed')
    world.run(0.5)
    last = world.samples[-1]
    truth = world.wire.emulators[0].samples.truth
    np.testing.assert_allclose(last.wheels.efforts, 0.01, rtol=1e-3)
    assert (truth.wheel_speeds > 20.0).all()
    # The speeds are those of one step before, as means over a period.
    np.testing.assert_allclose(last.wheels.speeds, truth.wheel_speeds, atol=0.5)
    positions = np.array([samples.wheels.angles for samples in world.samples])
    speeds = np.array([samples.wheels.speeds for samples in world.samples])
    np.testing.assert_allclose(
        np.diff(positions, axis=0)[-100:] / 4e-3, speeds[-100:], atol=0.5)


@pytest.mark.medium
def test_disarming_ends_torque(world) -> None:
    world.torque(0.01, 0.01, 0.01, 0.01)
    assert world.arm()[0]
    world.run(0.2)
    world.testbed.disarm('test')
    world.command = None
    # The motor torque decays with a time constant of 3 ms.
    world.run(0.1)
    np.testing.assert_allclose(world.samples[-1].wheels.efforts, 0.0, atol=1e-9)


@pytest.mark.medium
@pytest.mark.parametrize('loss', [0.01, 0.05])
def test_lost_frames_are_counted_and_do_no_harm(world, loss: float) -> None:
    world.wire.loss = loss
    world.torque(1e-3, 1e-3, 1e-3, 1e-3)
    assert world.arm()[0]
    world.run(2.0)
    assert world.testbed.arming.armed
    assert all(samples.complete for samples in world.samples[-500:])
    values = world.prototype.diagnostic_values()
    assert sum(values.get(f'{name}.lost_angles', 0)
               for name in world.prototype.sensor_names) > 2000 * loss / 3
