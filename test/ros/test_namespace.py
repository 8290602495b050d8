# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A namespace contains all names but /diagnostics, and separates two testbeds."""

import pytest
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.node

GLOBAL = {'/diagnostics', '/rosout', '/parameter_events'}


@pytest.fixture(scope='module')
def labs(module_suite, make_probe):
    """Return two testbeds in namespaces, with a probe in each."""
    probes = {}
    for name, angle in (('lab', 0.0), ('other', 1.0)):
        module_suite.nodes(
            # Two cores are too slow for two loops at full rate.
            f'/{name}', plant={'rate': 100.0, 'initial.link_a': angle,
                               'initial.link_b': angle + 1.0},
            controller={'setpoint_duration': 1.0})
        probes[name] = make_probe(f'/{name}')
        probes[name].follow('estimate/link_states', 'flywheel_command', 'sim/link_states')
    for probe in probes.values():
        probe.newest('flywheel_command')
    return probes


def test_nothing_is_outside_the_namespace(labs):
    topics = {name for name, _ in labs['lab'].node.get_topic_names_and_types()}
    assert {name for name in topics if not name.startswith(('/lab/', '/other/'))} <= GLOBAL
    assert '/diagnostics' in topics
    services = [name for name, _ in labs['lab'].node.get_service_names_and_types()]
    assert {'/lab/arm', '/other/arm'} < set(services)
    assert all(name.startswith(('/lab/', '/other/')) for name in services)


def test_status_on_the_common_diagnostics_names_its_node(labs):
    for name in ('lab/plant', 'lab/estimator', 'lab/controller', 'other/plant'):
        assert labs['lab'].diagnostics(name).name == name


@pytest.mark.slow
def test_loop_in_a_namespace_has_no_effect_on_the_other_one(labs):
    lab, other = labs['lab'], labs['other']
    before = other.status('controller_status')
    assert lab.arm().success
    lab.status('controller_status', mode='hold')
    decision = lab.setpoint_decision(
        JointState(name=['link_a', 'link_b'], position=[0.1, 1.1]),
        lab.publisher(JointState, 'setpoint'))
    assert decision['mode'] == 'track'
    lab.status('controller_status', mode='hold')
    lab.wait(lambda: lab.received['sim/link_states'][-1].position[0] == pytest.approx(
        0.1, abs=0.02))
    assert other.status('device_status')['state'] == 'disarmed'
    assert other.status('controller_status') == before
    assert other.more('sim/link_states')[0].position[0] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.slow
def test_nodes_follow_remapping(suite, make_probe):
    suite.node('plant', arguments=('-r', 'flywheel_states:=wheels', '-r', '__node:=table'))
    probe = make_probe()
    probe.follow('wheels')
    probe.newest('wheels')
    assert probe.diagnostics('table').name == 'table'
    assert probe.arm().message == 'armed'
