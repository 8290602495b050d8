# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`sim/pause`, `sim/step`, `sim/reset` in every clock mode, by services and `fourbar sim`."""

import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_srvs.srv import SetBool

pytestmark = pytest.mark.node

PERIOD_NS = 4_000_000
WATCHDOG_S = 1.0


def stamps(messages):
    return [message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            for message in messages]


def distinct(messages):
    """Return the stamps without repetitions: lock-step repeats a tick whose answer is late."""
    return list(dict.fromkeys(stamps(messages)))


@pytest.fixture(scope='module', params=[
    pytest.param('realtime', marks=pytest.mark.slow),
    pytest.param('fast', marks=pytest.mark.slow), 'lockstep'])
def testbed(request, module_suite, make_probe):
    """Run a plant in each clock mode, its wheels driven by the probe."""
    namespace = f'/{request.param}'
    process = module_suite.node('plant', {
        'clock': request.param, 'command_timeout': WATCHDOG_S}, namespace)
    testbed = make_probe(namespace)
    testbed.drive([0.0] * 4)
    testbed.follow('flywheel_states', 'sim/link_states', 'sim/flywheel_states')
    testbed.newest('sim/flywheel_states')
    yield testbed
    testbed.unfollow()
    testbed.drive(None)
    process.end(2)


@pytest.fixture(autouse=True)
def running(testbed):
    """Leave every plant running, disarmed, in its initial state."""
    yield
    testbed.drive([0.0] * 4)
    set_initial(testbed, link_a=0.0, link_b=1.0)
    assert testbed.trigger('sim/reset').success
    testbed.arm(False)
    pause(testbed, False)


def pause(testbed, wanted=True):
    response = testbed.call(SetBool, 'sim/pause', SetBool.Request(data=wanted))
    assert response.success
    assert response.message.startswith('paused at ' if wanted else 'running at ')


def stamp_in(message):
    """Return the stamp [ns] in an answer such as `tick at 1.004000000 s`."""
    return int(message.split()[2].replace('.', ''))


def step(testbed):
    """Make one tick after the answer to the last one, and return its stamp."""
    def stepped():
        response = testbed.trigger('sim/step')
        assert response.success or 'not answered yet' in response.message
        return response.message if response.success else None
    message = testbed.wait(stepped)
    assert message.startswith('tick at ')
    return stamp_in(message)


def set_initial(testbed, **values):
    """Set parameters `initial.*` [rad], and check that they are accepted."""
    results = testbed.call(SetParameters, 'plant/set_parameters', SetParameters.Request(
        parameters=[Parameter(name=f'initial.{name}', value=ParameterValue(
            type=ParameterType.PARAMETER_DOUBLE, double_value=value))
            for name, value in values.items()])).results
    assert all(result.successful for result in results), results


def quiet(testbed):
    """Check that no further tick follows, and return the stamp of the last one."""
    testbed.catch_up()
    last = stamps(testbed.received['flywheel_states'])[-1]
    # Two diagnostics are at least one command timeout apart.
    testbed.diagnostics(f'{testbed.node.get_namespace()[1:]}/plant',
                        lambda status: 'paused' in status.message)
    testbed.diagnostics(f'{testbed.node.get_namespace()[1:]}/plant')
    testbed.catch_up()
    assert stamps(testbed.received['flywheel_states'])[-1] == last
    return last


def test_paused_plant_stays_armed_and_continues(testbed):
    """A pause longer than the command timeout does not disarm the plant."""
    testbed.wait(lambda: testbed.arm().success)
    testbed.drive([2e-5] * 4)
    testbed.more('sim/flywheel_states', 50)
    pause(testbed)
    last = quiet(testbed)
    testbed.diagnostics(f'{testbed.node.get_namespace()[1:]}/plant')
    assert testbed.status('device_status')['state'] == 'armed'
    count = len(testbed.received['flywheel_states'])
    pause(testbed, False)
    testbed.more('flywheel_states', 50)
    assert testbed.status('device_status')['state'] == 'armed'
    after = [stamp for stamp in distinct(testbed.received['flywheel_states'][count:])
             if stamp > last]
    # Simulated time has no gap at the pause, in the real-time clock mode too.
    assert after[0] == last + PERIOD_NS
    assert after[:50] == list(range(after[0], after[0] + 50 * PERIOD_NS, PERIOD_NS))


def test_emergency_stop_acts_while_paused(testbed):
    """The supervisor handles requests while time stands still."""
    testbed.wait(lambda: testbed.arm().success)
    pause(testbed)
    assert testbed.trigger('emergency_stop').success
    testbed.status('device_status', state='emergency_stop')
    assert testbed.trigger('reset_emergency_stop').success
    testbed.status('device_status', state='disarmed')


def test_step_makes_one_tick(testbed):
    pause(testbed)
    last = quiet(testbed)
    assert [step(testbed) for _ in range(5)] == [last + n * PERIOD_NS for n in range(1, 6)]
    assert quiet(testbed) == last + 5 * PERIOD_NS


def test_step_is_refused_while_running(testbed):
    response = testbed.trigger('sim/step')
    assert not response.success
    assert response.message == 'refused: the clock is running, pause it first'


def test_reset_sets_the_state_disarms_and_does_not_change_time(testbed):
    testbed.wait(lambda: testbed.arm().success)
    testbed.drive([3e-5] * 4)
    testbed.more('sim/link_states', 50)
    pause(testbed)
    last = quiet(testbed)
    set_initial(testbed, link_a=0.3, link_b=1.2)
    response = testbed.trigger('sim/reset')
    assert response.success
    assert testbed.status('device_status', state='disarmed')['reason'] == 'sim/reset'
    assert step(testbed) == last + PERIOD_NS
    testbed.wait(lambda: stamps(testbed.received['sim/link_states'])[-1] == last + PERIOD_NS)
    links, wheels = (testbed.received[f'sim/{name}'][-1]
                     for name in ('link_states', 'flywheel_states'))
    assert links.position[:2] == pytest.approx([0.3, 1.2], abs=1e-12)
    assert links.velocity == pytest.approx([0.0] * 4, abs=1e-12)
    assert wheels.velocity == pytest.approx([0.0] * 4, abs=1e-9)


def test_reset_to_an_impossible_state_is_refused_and_has_no_effect(testbed):
    testbed.wait(lambda: testbed.arm().success)
    pause(testbed)
    step(testbed)
    testbed.catch_up()
    before = testbed.received['sim/link_states'][-1].position
    # The links of the paper have equal lengths: at a change point rates a and b do not suffice.
    set_initial(testbed, link_a=0.0, link_b=0.0, rate_a=1.0)
    response = testbed.trigger('sim/reset')
    set_initial(testbed, rate_a=0.0)
    assert not response.success
    assert response.message.startswith('refused: ')
    assert '\n' not in response.message
    assert testbed.status('device_status')['state'] == 'armed'
    after = step(testbed)
    testbed.wait(lambda: stamps(testbed.received['sim/link_states'])[-1] == after)
    assert testbed.received['sim/link_states'][-1].position == pytest.approx(before, abs=1e-9)


@pytest.mark.slow
def test_command_line_has_the_same_effect_as_the_services(testbed, suite):
    def sim(action):
        process = suite.start('sim', action, '--ros-args', '-r',
                              f'__ns:={testbed.node.get_namespace()}')
        return process.end(), process.stdout, process.stderr
    code, out, err = sim('step')
    assert (code, out, err) == (1, '', 'refused: the clock is running, pause it first\n')
    code, out, err = sim('pause')
    assert (code, out.startswith('paused at '), err) == (0, True, '')
    last = quiet(testbed)
    code, out, err = sim('step')
    assert (code, err) == (0, '')
    assert stamp_in(out) == last + PERIOD_NS
    code, out, err = sim('reset')
    assert (code, out.startswith('reset and disarmed at '), err) == (0, True, '')
    code, out, err = sim('resume')
    assert (code, out.startswith('running at '), err) == (0, True, '')
    testbed.more('flywheel_states', 5)
