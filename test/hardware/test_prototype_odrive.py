# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The prototype with ODrives in place of the motor drivers of the links."""

from fourbar_ros.device import DeviceState
from fourbar_ros.hardware.odrive_codec import OdriveCodec
from fourbar_ros.mechanism import load_mechanism
import numpy as np
import pytest

TORQUE = (0.01, -0.01, 0.02, -0.02)


@pytest.fixture
def world(make_world):
    """Return a settled world with CANSimple on its bus."""
    codec = OdriveCodec(torque_constants=load_mechanism('prototype').motor_torque_constants)
    world = make_world(codec)
    world.run(1.0)
    return world


@pytest.mark.medium
def test_wheels_are_driven_and_measured(world) -> None:
    world.torque(*TORQUE)
    assert world.arm() == (True, 'armed')
    world.run(0.5)
    last, truth = world.samples[-1], world.wire.emulators[0].samples.truth
    assert last.complete
    np.testing.assert_allclose(last.wheels.efforts, TORQUE, rtol=1e-3)
    np.testing.assert_allclose(last.wheels.speeds, truth.wheel_speeds, atol=0.5)
    positions = np.array([samples.wheels.angles for samples in world.samples[-100:]])
    assert (np.diff(positions, axis=0) * np.sign(TORQUE) > 0.0).all()
    world.testbed.disarm('test')
    world.command = None
    world.run(0.1)
    np.testing.assert_allclose(world.samples[-1].wheels.efforts, 0.0, atol=1e-9)


@pytest.mark.slow
def test_speeds_are_followed(world) -> None:
    names = [f'flywheel_{letter}' for letter in 'abcd']

    def give() -> None:
        world.testbed.command(world.samples[-1].stamp_ns, names, [], [20.0, -10.0, 5.0, 0.0],
                              [], world.wire.now_ns)
    world.command = give
    assert world.arm()[0]
    world.run(1.0)
    np.testing.assert_allclose(
        world.wire.emulators[0].samples.truth.wheel_speeds, [20.0, -10.0, 5.0, 0.0], atol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(('kind', 'state'), [
    ('silent', DeviceState.DISARMED), ('low_battery', DeviceState.DISARMED)])
def test_safety_rules_apply_with_odrives(world, kind, state) -> None:
    world.torque(*TORQUE)
    assert world.arm()[0]
    world.run(0.2)
    world.wire.emulators[0].inject_fault('link_d', kind)
    world.run(1.0)
    assert world.testbed.arming.state is state or not world.testbed.arming.armed
    assert world.testbed.arming.reason.startswith('link_d: ')


@pytest.mark.slow
def test_emergency_stop_holds_the_drivers_too(world) -> None:
    world.torque(*TORQUE)
    assert world.arm()[0]
    world.run(0.2)
    world.testbed.emergency_stop('test')
    world.run(0.1)
    assert not any(firmware.drive()[2] for firmware in world.wire.emulators[0].firmware)
    world.testbed.reset()
    world.run(0.3)
    assert world.arm() == (True, 'armed')
