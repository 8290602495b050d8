# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Every topic and service of the three nodes: type, quality of service, names, arrays."""

from math import atan2, cos, pi, sin

from nav_msgs.msg import Odometry
import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

pytestmark = pytest.mark.node

LINKS = ['link_a', 'link_b', 'link_c', 'link_d']
WHEELS = ['flywheel_a', 'flywheel_b', 'flywheel_c', 'flywheel_d']
ANGLE_AND_RATE = ('position', 'velocity')
ALL = ('position', 'velocity', 'effort')

# Names and non-empty arrays of every JointState, by publisher.
JOINT_STATES = {
    'plant': {
        'link_angles': (LINKS, ('position',)),
        'flywheel_states': (WHEELS, ALL),
        'timing': (['round_trip_s', 'command_age_s', 'lost', 'step_s'], ('position',)),
        'sim/link_states': (LINKS, ANGLE_AND_RATE),
        'sim/flywheel_states': (WHEELS, ALL),
        'sim/ledger': ([
            'links_j', 'wheels_j', 'springs_j', 'supplied_j', 'tilt_j', 'disturbance_j',
            'copper_j', 'bearings_j', 'joints_j', 'drag_j', 'edge_j', 'unaccounted_j',
            'links_spin_n_m_s', 'wheels_spin_n_m_s', 'drag_spin_n_m_s', 'edge_spin_n_m_s',
            'disturbance_spin_n_m_s', 'unaccounted_spin_n_m_s', 'contacts'], ('position',)),
    },
    'estimator': {
        'estimate/link_states': (LINKS, ALL),
        'estimate/sigma': (LINKS, ANGLE_AND_RATE),
        'estimate/covariance': ([
            'phi_a.phi_a', 'phi_a.phi_b', 'phi_a.omega_a', 'phi_a.omega_b', 'phi_b.phi_b',
            'phi_b.omega_a', 'phi_b.omega_b', 'omega_a.omega_a', 'omega_a.omega_b',
            'omega_b.omega_b'], ('position',)),
        'estimate/disturbance': (['torque_a', 'torque_b', 'sigma_a', 'sigma_b'], ('position',)),
        'estimate/decisions': (LINKS, ALL),
        'estimate/innovation': (['nis', 'degrees_of_freedom', *LINKS], ('position',)),
    },
    'controller': {
        'flywheel_command': (WHEELS, ('effort',)),
        'reference': (LINKS, ANGLE_AND_RATE),
        'tracking_error': (LINKS, ANGLE_AND_RATE),
        'energy': (['flywheel_energy_j', 'eq9_j_s', 'work_j', 'copper_loss_j'], ('position',)),
        'allocation': (
            ['scale', 'condition_number', 'branch_hold', *(
                form.format(link) for form in (
                    'saturated_{}', 'verdict_{}', 'null_speed_{}_rad_s') for link in 'abcd')],
            ('position',)),
        'momentum': (['total_n_m_s', 'axis_a_n_m_s', 'axis_b_n_m_s', 'margin', 'time_left_s'],
                     ('position',)),
    },
}
TOPICS = {topic: form for topics in JOINT_STATES.values() for topic, form in topics.items()}
STATUSES = {'plant': 'device_status', 'controller': 'controller_status'}

# Subscriptions of each node, and whether they are reliable.
SUBSCRIPTIONS = {
    'plant': {'flywheel_command': True, 'emergency_stop_request': True},
    'estimator': {'link_angles': False, 'flywheel_states': False},
    'controller': {'flywheel_states': False, 'estimate/link_states': True, 'setpoint': True,
                   'trajectory': True, 'device_status': True},
}
SERVICES = {
    'plant': {'/sim/pause': 'std_srvs/srv/SetBool', '/sim/step': 'std_srvs/srv/Trigger',
              '/sim/reset': 'std_srvs/srv/Trigger', '/arm': 'std_srvs/srv/SetBool',
              '/emergency_stop': 'std_srvs/srv/Trigger',
              '/reset_emergency_stop': 'std_srvs/srv/Trigger'},
    'estimator': {'/estimate/reset': 'std_srvs/srv/Trigger'},
    'controller': {'/enable': 'std_srvs/srv/SetBool', '/hold': 'std_srvs/srv/Trigger',
                   '/damp': 'std_srvs/srv/Trigger'},
}
JOINT_STATE, STATUS = 'sensor_msgs/msg/JointState', 'diagnostic_msgs/msg/DiagnosticStatus'
# Topics of every node of rclpy.
OF_ROS = {'/rosout', '/parameter_events'}

each_node = pytest.mark.parametrize('name', list(JOINT_STATES))


def stamp_of(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


@pytest.fixture(scope='module')
def testbed(module_suite, probe):
    module_suite.nodes()
    probe.follow(*TOPICS)
    for topic in TOPICS:
        probe.newest(topic)
    for topic in STATUSES.values():
        probe.status(topic)
    return probe


@pytest.fixture(autouse=True)
def all_topics_are_not_followed_at_once(testbed):
    """End the subscriptions after a test: twelve of them need as much time as the nodes."""
    testbed.unfollow()


def types_by_name(pairs):
    return {name: types[0] for name, types in pairs if name not in OF_ROS}


@each_node
def test_node_publishes_exactly_its_topics(testbed, name):
    expected = {f'/{topic}': JOINT_STATE for topic in JOINT_STATES[name]}
    expected['/diagnostics'] = 'diagnostic_msgs/msg/DiagnosticArray'
    if name in STATUSES:
        expected[f'/{STATUSES[name]}'] = STATUS
    if name == 'plant':
        expected['/sim/odometry'] = 'nav_msgs/msg/Odometry'
    if name == 'estimator':
        expected['/estimate/waiting'] = 'std_msgs/msg/Header'
    found = testbed.node.get_publisher_names_and_types_by_node(name, '/')
    assert types_by_name(found) == expected


@each_node
def test_node_subscribes_to_exactly_its_topics(testbed, name):
    found = types_by_name(testbed.node.get_subscriber_names_and_types_by_node(name, '/'))
    special = {'/device_status': STATUS, '/emergency_stop_request': 'std_msgs/msg/Bool',
               '/trajectory': 'trajectory_msgs/msg/JointTrajectory'}
    assert found == {f'/{topic}': special.get(f'/{topic}', JOINT_STATE)
                     for topic in SUBSCRIPTIONS[name]}


@each_node
def test_node_offers_exactly_its_services(testbed, name):
    found = testbed.node.get_service_names_and_types_by_node(name, '/')
    assert {service: types[0] for service, types in found
            if not service.startswith(f'/{name}/')} == SERVICES[name]
    own = {service.rpartition('/')[2] for service, _ in found if service.startswith(f'/{name}/')}
    assert own == {
        'describe_parameters', 'get_parameter_types', 'get_parameters', 'list_parameters',
        'set_parameters', 'set_parameters_atomically', 'get_type_description'}


@each_node
def test_publishers_are_reliable_and_only_statuses_latched(testbed, name):
    for topic in (*JOINT_STATES[name], '/diagnostics', *(
            [STATUSES[name]] if name in STATUSES else [])):
        offered, = [info.qos_profile for info in
                    testbed.node.get_publishers_info_by_topic(f'/{topic.lstrip("/")}')
                    if info.node_name == name]
        assert (topic, offered.reliability) == (topic, ReliabilityPolicy.RELIABLE)
        latched = offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert (topic, latched) == (topic, topic in STATUSES.values())


@each_node
def test_subscribers_request_the_documented_quality_of_service(testbed, name):
    for topic, reliable in SUBSCRIPTIONS[name].items():
        wanted, = [info.qos_profile for info in
                   testbed.node.get_subscriptions_info_by_topic(f'/{topic}')
                   if info.node_name == name]
        assert (topic, wanted.reliability == ReliabilityPolicy.RELIABLE) == (topic, reliable)
        # A latched subscriber does not receive from the volatile publisher of `ros2 topic pub`.
        latched = wanted.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert (topic, latched) == (topic, topic in STATUSES.values())


@pytest.mark.parametrize('topic', list(TOPICS))
def test_names_are_in_order_and_unused_arrays_are_empty(testbed, topic):
    names, fields = TOPICS[topic]
    for message in testbed.more(topic, 50):
        # A tick without an answer has no round trip, and wheels without drift have no time to
        # their limit: the message omits them.
        unmeasured = {'round_trip_s', 'time_left_s'} - set(message.name)
        assert message.name == [name for name in names if name not in unmeasured]
        for field in ALL:
            length = len(message.name) if field in fields else 0
            assert (field, len(getattr(message, field))) == (field, length)
            assert all(value == value for value in getattr(message, field))
        assert message.header.stamp.sec > 0


def test_link_angles_are_wrapped_at_half_a_turn(make_probe, module_suite):
    """Link a is at half a turn, so the noise changes the sign of the measured angle often."""
    module_suite.node('plant', {'initial.link_a': pi, 'initial.link_b': 20.0}, '/turned')
    watcher = make_probe('/turned')
    watcher.follow('link_angles', 'sim/link_states')
    messages = watcher.more('link_angles', 200)
    angles = [angle for message in messages for angle in message.position]
    assert all(-pi < angle <= pi for angle in angles)
    first = [message.position[0] for message in messages]
    assert min(first) < -3.0 < 3.0 < max(first)
    assert watcher.newest('sim/link_states').position[1] == pytest.approx(20.0)


def test_timing_of_a_running_loop_is_plausible(testbed):
    for message in testbed.more('timing', 50):
        timing = dict(zip(message.name, message.position))
        assert 0.0 < timing.get('round_trip_s', 1e-9) < timing['command_age_s'] + 1.0
        assert 0.0 < timing['step_s'] < 1.0
        assert timing['lost'] == int(timing['lost']) >= 0


def test_timing_omits_unknown_values(make_probe, module_suite):
    module_suite.node('plant', namespace='/alone')
    watcher = make_probe('/alone')
    watcher.follow('timing')
    message = watcher.newest('timing')
    assert message.name == ['lost', 'step_s']
    assert message.position[0] == 0.0


def test_diagnostics_come_every_second_from_every_node(testbed):
    for name in JOINT_STATES:
        testbed.diagnostics(name)
    arrays = testbed.received['/diagnostics']
    begin = len(arrays)
    testbed.wait(lambda: all(
        sum(array.status[0].name == name for array in arrays[begin:]) >= 3
        for name in JOINT_STATES), seconds=20.0)
    for name in JOINT_STATES:
        stamps = [array.header.stamp.sec + array.header.stamp.nanosec * 1e-9
                  for array in arrays[begin:] if array.status[0].name == name]
        # Three messages take two seconds; two more are a margin for a busy machine.
        assert stamps[2] - stamps[0] < 4.0


@each_node
def test_healthy_node_reports_ok(testbed, name):
    status = testbed.diagnostics(name)
    values = {item.key: item.value for item in status.values}
    # On a busy machine a sample may arrive after its tick, which is a warning.
    overtaken = name == 'estimator' and status.message == 'running, measurements were rejected'
    assert status.level == (b'\x01' if overtaken else b'\x00'), values
    assert {key for key in values if key.startswith('rejected_')} <= {'rejected_late'}


def test_statuses_have_their_keys(testbed):
    device = testbed.status('device_status')
    assert set(device) == {'state', 'reason', 'since', 'mechanism'}
    assert device['state'] == 'disarmed'
    assert device['mechanism'] == 'paper'
    controller = testbed.status('controller_status')
    assert {'mode', 'goal', 'branch', 'last_refusal', 'problem', 'wheel_faults'} < set(controller)
    assert (controller['mode'], controller['goal']) == ('disarmed', '')
    assert (controller['problem'], controller['wheel_faults']) == ('', '')


def test_late_subscriber_receives_both_statuses(testbed, make_probe):
    testbed.arm()
    armed = testbed.status('device_status', state='armed')
    held = testbed.status('controller_status', mode='hold')
    late = make_probe()
    assert late.status('device_status', state='armed') == armed
    assert late.status('controller_status', mode='hold') == held
    assert len(late.received['device_status']) == 1
    testbed.arm(False)
    testbed.status('device_status', state='disarmed')
    assert float(armed['since']) > 1e9


def test_odometry_is_that_of_link_a(testbed):
    """The orientation is that of link a; joint 1 turns about the mass centre, which is at rest."""
    odometry = testbed.follow('sim/odometry', kind=Odometry)
    testbed.wait(lambda: len(odometry) > 50)
    testbed.follow('sim/link_states')
    testbed.more('sim/link_states', 20)
    truth = {stamp_of(message): message for message in testbed.received['sim/link_states']}
    message = testbed.wait(lambda: next(
        (one for one in reversed(odometry) if stamp_of(one) in truth), None))
    assert (message.header.frame_id, message.child_frame_id) == ('table', 'link_a')
    link = truth[stamp_of(message)]
    angle = link.position[0]
    orientation = message.pose.pose.orientation
    assert 2.0 * atan2(orientation.z, orientation.w) == pytest.approx(angle, abs=1e-9)
    # The mass centre of the rhombus stays in the origin; joint 1 is half of link a and half of
    # link b away from it.
    place = message.pose.pose.position
    other = link.position[1]
    assert [place.x, place.y] == pytest.approx(
        [-0.05 * (cos(angle) + cos(other)), -0.05 * (sin(angle) + sin(other))], abs=1e-9)
    assert message.twist.twist.angular.z == link.velocity[0]
    testbed.node.destroy_subscription(next(
        one for one in testbed.node.subscriptions if one.topic_name.endswith('odometry')))
