# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar calibrate` over DDS estimates the parameters of the plant and ends without torque."""

import json
import signal

from fourbar_ros.mechanism import load_mechanism
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType
from rcl_interfaces.srv import SetParameters
import yaml

pytestmark = pytest.mark.node

WHEELS = ('wheels', '--wheels', 'flywheel_b', '--speed', '45', '--coast', '2.5', '--yes')


@pytest.fixture(scope='module')
def plant(module_suite, probe):
    """Run the bench-scale linkage on the table of a laboratory, without a controller."""
    module_suite.node('plant', {
        'mechanism': 'prototype', 'table': 'prototype', 'command_timeout': 0.1})
    probe.newest('flywheel_states')
    probe.status('device_status', state='disarmed')
    probe.unfollow()
    probe.follow('flywheel_command')
    return probe


@pytest.fixture
def start(plant, module_suite):
    """Return a function that starts the command, with the plant at rest and disarmed."""
    assert plant.trigger('sim/reset').success
    plant.status('device_status', state='disarmed')
    plant.catch_up()
    plant.received['flywheel_command'].clear()
    return lambda *arguments: module_suite.start('calibrate', *arguments)


def wait_for_torque(plant):
    """Wait until a wheel has torque."""
    commands = plant.received['flywheel_command']
    plant.wait(lambda: any(any(command.effort) for command in commands))


def check_left_without_torque(plant):
    """Check that the device is disarmed, and that commands before that were zero."""
    plant.catch_up()
    assert plant.state() == 'disarmed'
    commands = plant.received['flywheel_command']
    assert list(commands[-1].name) == [f'flywheel_{letter}' for letter in 'abcd']
    assert list(commands[-1].effort) == [0.0] * 4


@pytest.mark.slow
def test_encoder_offsets_of_a_plant_without_offsets_are_zero(start, tmp_path):
    """The tolerance is five standard errors of 450 samples with 0.1 deg of noise."""
    made, numbers = tmp_path / 'mechanism.yaml', tmp_path / 'zeros.json'
    process = start('encoders', '--pose', 'link_a=0', 'link_b=60deg', '--duration', '2',
                    '-o', str(made), '--json', str(numbers))
    assert process.end() == 0, process.stderr
    offsets = load_mechanism(str(made)).link_angle_offsets
    np.testing.assert_allclose(offsets, 0.0, atol=5.0 * 1.75e-3 / np.sqrt(450))
    assert offsets.any()
    found = json.loads(numbers.read_text())
    assert min(found['samples']) > 450
    assert all(check['passed'] for check in found['checks'])


def test_inertia_and_friction_of_one_wheel_are_found(start, plant, tmp_path):
    """
    The inertia and the friction agree to 1 %; the recording gives the same estimate again.

    The short coast-down determines the total friction at its speeds. It separates Coulomb from
    viscous friction only to half a percent of the former, so each of them alone may deviate by
    four standard errors.
    """
    made, numbers, again, bag, report = (tmp_path / name for name in (
        'mechanism.yaml', 'wheels.json', 'again.json', 'bag', 'report.yaml'))
    process = start(*WHEELS, '-o', str(made), '--json', str(numbers), '--record', str(bag),
                    '--report', str(report))
    assert process.end() == 0, process.stderr + process.stdout
    found = json.loads(numbers.read_text())
    inertia, coulomb, viscous = found['quantities'][:3]
    assert inertia['value'] == pytest.approx(1.2e-4, rel=0.01)
    for speed in (25.0, 45.0):
        friction = coulomb['value'] + speed * viscous['value']
        assert friction == pytest.approx(1e-3 + speed * 2e-6, rel=0.01)
    for part, true in ((coulomb, 1e-3), (viscous, 2e-6)):
        assert abs(part['value'] - true) <= 4.0 * part['standard_error']
    controller = yaml.safe_load(report.read_text())['controller']
    assert controller['bearing_coulomb'] == coulomb['value']
    np.testing.assert_array_equal(
        load_mechanism(str(made)).flywheel_inertias, [1.2e-4, inertia['value'], 1.2e-4, 1.2e-4])
    check_left_without_torque(plant)
    process = start('wheels', '--bag', str(bag), '--json', str(again))
    assert process.end() == 0, process.stderr
    assert json.loads(again.read_text())['quantities'] == found['quantities']


@pytest.mark.slow
def test_command_ends_when_the_device_is_disarmed(start, plant):
    process = start(*WHEELS)
    wait_for_torque(plant)
    plant.arm(False)
    assert process.end() == 2
    assert 'the device does not drive any more: disarmed (disarmed on request)' in process.stderr
    check_left_without_torque(plant)


def test_interrupt_leaves_the_wheels_without_torque(start, plant):
    process = start(*WHEELS)
    wait_for_torque(plant)
    assert process.end(signal.SIGINT) == 130
    assert process.stderr.splitlines()[-1] == 'fourbar calibrate: interrupted'
    plant.status('device_status', state='disarmed')
    check_left_without_torque(plant)


@pytest.mark.slow
def test_command_ends_without_a_recording_near_a_change_point(
        start, plant, tmp_path):
    bag, parameter = tmp_path / 'bag', Parameter(name='initial.link_b')
    parameter.value.type = ParameterType.PARAMETER_DOUBLE
    # The first angle is for this reset, the second for the resets of other tests.
    for angle in (0.24, float(np.pi / 3.0)):
        parameter.value.double_value = angle
        result, = plant.call(SetParameters, 'plant/set_parameters',
                             SetParameters.Request(parameters=[parameter])).results
        assert result.successful
        if angle == 0.24:
            assert plant.trigger('sim/reset').success
    process = start('links', '--yes', '--record', str(bag))
    assert process.end() == 2
    for part in ('change point', 'limit 10.0 deg'):
        assert part in process.stderr.splitlines()[-1]
    assert not bag.exists()
    check_left_without_torque(plant)


def test_second_publisher_of_commands_is_refused(start, plant):
    plant.drive([0.0] * 4)
    process = start(*WHEELS)
    assert process.end() == 2
    assert process.stderr.splitlines()[-1] == (
        'fourbar calibrate: /flywheel_command has a publisher already: stop the controller')
    assert plant.state() == 'disarmed'


@pytest.mark.slow
def test_missing_device_is_reported(start):
    process = start('encoders', '--pose', 'link_a=0', 'link_b=1', '--ros-args', '-r',
                    '__ns:=/elsewhere')
    assert process.end() == 2
    line, = process.stderr.splitlines()
    assert line.startswith('fourbar calibrate: ')
    assert 'device_status' in line
