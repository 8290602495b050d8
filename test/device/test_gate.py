# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The arming gate, every state against every event."""

from collections.abc import Callable
from typing import Any

from fourbar_ros.device import DeviceState
from fourbar_ros.device.arming import Arming
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

DISARMED, ARMED, STOPPED, FAULT = (
    DeviceState.DISARMED, DeviceState.ARMED, DeviceState.EMERGENCY_STOP, DeviceState.FAULT)
NOW = 5
EVENTS: dict[str, Callable[[Arming], Any]] = {
    'arm': lambda gate: gate.arm(NOW, []),
    'arm despite an obstacle': lambda gate: gate.arm(NOW, ['the door is open']),
    'disarm': lambda gate: gate.disarm(NOW, 'new reason'),
    'stop': lambda gate: gate.emergency_stop(NOW, 'new reason'),
    'fail': lambda gate: gate.fail(NOW, 'new reason'),
    'reset': lambda gate: gate.reset(NOW),
}
WAYS = {
    DISARMED: [],
    ARMED: ['arm'],
    STOPPED: ['arm', 'stop'],
    FAULT: ['arm', 'fail'],
}
# What follows each event, by the state before it.
AFTER = {
    'arm': {DISARMED: ARMED, ARMED: ARMED, STOPPED: STOPPED, FAULT: FAULT},
    'arm despite an obstacle': {
        DISARMED: DISARMED, ARMED: ARMED, STOPPED: STOPPED, FAULT: FAULT},
    'disarm': {DISARMED: DISARMED, ARMED: DISARMED, STOPPED: STOPPED, FAULT: FAULT},
    'stop': {DISARMED: STOPPED, ARMED: STOPPED, STOPPED: STOPPED, FAULT: STOPPED},
    'fail': {DISARMED: FAULT, ARMED: FAULT, STOPPED: STOPPED, FAULT: FAULT},
    'reset': {DISARMED: DISARMED, ARMED: ARMED, STOPPED: DISARMED, FAULT: DISARMED},
}


def gate_in(state: DeviceState) -> Arming:
    """Bring a new gate into a state, through the events that lead there."""
    gate = Arming()
    for event in WAYS[state]:
        EVENTS[event](gate)
    gate.reason, gate.since_ns = 'old reason', 1
    assert gate.state is state
    return gate


@pytest.mark.parametrize('before', list(DeviceState), ids=lambda state: state.value)
@pytest.mark.parametrize('event', list(EVENTS))
def test_event_leads_where_the_table_says(event: str, before: DeviceState) -> None:
    gate = gate_in(before)
    EVENTS[event](gate)
    assert gate.state is AFTER[event][before]
    assert gate.armed is (gate.state is ARMED)
    if gate.state is before:
        # Nothing happened: the first reason is the one worth knowing.
        assert (gate.reason, gate.since_ns) == ('old reason', 1)
    else:
        assert gate.reason != 'old reason'
        assert gate.since_ns == NOW


def test_new_gate_is_disarmed() -> None:
    assert Arming().state is DISARMED
    assert not Arming().armed


@pytest.mark.parametrize(('state', 'arming_blockers', 'needles'), [
    (DISARMED, ['no sample from link_c', 'two publishers'],
     ['no sample from link_c', 'two publishers']),
    (STOPPED, [], ['emergency_stop', 'old reason', 'reset_emergency_stop']),
    (FAULT, [], ['fault', 'old reason', 'reset_emergency_stop']),
])
def test_refusal_says_why(
        state: DeviceState, arming_blockers: list[str], needles: list[str]) -> None:
    armed, message = gate_in(state).arm(NOW, arming_blockers)
    assert not armed
    for needle in needles:
        assert needle in message


@pytest.mark.parametrize('state', [DISARMED, ARMED])
def test_arming_tells_success(state: DeviceState) -> None:
    assert gate_in(state).arm(NOW, [])[0]


@pytest.mark.parametrize('state', list(DeviceState), ids=lambda state: state.value)
def test_reset_always_succeeds_and_tells_what_it_released(state: DeviceState) -> None:
    released, message = gate_in(state).reset(NOW)
    assert released
    assert state.value in message


@settings(max_examples=300, derandomize=True)
@given(events=st.lists(st.sampled_from(sorted(EVENTS)), max_size=30))
def test_only_a_reset_and_then_arm_lead_from_a_latched_state_to_armed(events: list[str]) -> None:
    """Whatever happens, `armed` is entered from `disarmed` alone, and only when asked."""
    gate = Arming()
    for event in events:
        before = gate.state
        EVENTS[event](gate)
        if gate.armed and before is not ARMED:
            assert (before, event) == (DISARMED, 'arm')
        if before in (STOPPED, FAULT) and gate.state not in (STOPPED, FAULT):
            assert (gate.state, event) == (DISARMED, 'reset')
