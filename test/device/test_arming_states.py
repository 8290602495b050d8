# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""State machine of arming: every event in every state."""

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
    'arm': lambda arming: arming.arm(NOW, []),
    'arm despite a blocker': lambda arming: arming.arm(NOW, ['the door is open']),
    'disarm': lambda arming: arming.disarm(NOW, 'new reason'),
    'stop': lambda arming: arming.emergency_stop(NOW, 'new reason'),
    'fail': lambda arming: arming.fail(NOW, 'new reason'),
    'reset': lambda arming: arming.reset(NOW),
}
WAYS = {
    DISARMED: [],
    ARMED: ['arm'],
    STOPPED: ['arm', 'stop'],
    FAULT: ['arm', 'fail'],
}
# State after each event, by the state before it.
AFTER = {
    'arm': {DISARMED: ARMED, ARMED: ARMED, STOPPED: STOPPED, FAULT: FAULT},
    'arm despite a blocker': {
        DISARMED: DISARMED, ARMED: ARMED, STOPPED: STOPPED, FAULT: FAULT},
    'disarm': {DISARMED: DISARMED, ARMED: DISARMED, STOPPED: STOPPED, FAULT: FAULT},
    'stop': {DISARMED: STOPPED, ARMED: STOPPED, STOPPED: STOPPED, FAULT: STOPPED},
    'fail': {DISARMED: FAULT, ARMED: FAULT, STOPPED: STOPPED, FAULT: FAULT},
    'reset': {DISARMED: DISARMED, ARMED: ARMED, STOPPED: DISARMED, FAULT: DISARMED},
}


def arming_in(state: DeviceState) -> Arming:
    """Bring a new state machine into a state by events."""
    arming = Arming()
    for event in WAYS[state]:
        EVENTS[event](arming)
    arming.reason, arming.since_ns = 'old reason', 1
    assert arming.state is state
    return arming


@pytest.mark.parametrize('before', list(DeviceState), ids=lambda state: state.value)
@pytest.mark.parametrize('event', list(EVENTS))
def test_event_leads_to_the_state_of_the_table(event: str, before: DeviceState) -> None:
    arming = arming_in(before)
    EVENTS[event](arming)
    assert arming.state is AFTER[event][before]
    assert arming.armed is (arming.state is ARMED)
    if arming.state is before:
        # The first reason is kept.
        assert (arming.reason, arming.since_ns) == ('old reason', 1)
    else:
        assert arming.reason != 'old reason'
        assert arming.since_ns == NOW


def test_initial_state_is_disarmed() -> None:
    assert Arming().state is DISARMED
    assert not Arming().armed


@pytest.mark.parametrize(('state', 'arming_blockers', 'needles'), [
    (DISARMED, ['no sample from link_c', 'two publishers'],
     ['no sample from link_c', 'two publishers']),
    (STOPPED, [], ['emergency_stop', 'old reason', 'reset_emergency_stop']),
    (FAULT, [], ['fault', 'old reason', 'reset_emergency_stop']),
])
def test_refusal_has_the_reason(
        state: DeviceState, arming_blockers: list[str], needles: list[str]) -> None:
    armed, message = arming_in(state).arm(NOW, arming_blockers)
    assert not armed
    for needle in needles:
        assert needle in message


@pytest.mark.parametrize('state', [DISARMED, ARMED])
def test_arming_reports_success(state: DeviceState) -> None:
    assert arming_in(state).arm(NOW, [])[0]


@pytest.mark.parametrize('state', list(DeviceState), ids=lambda state: state.value)
def test_reset_always_succeeds_and_names_the_released_parts(state: DeviceState) -> None:
    released, message = arming_in(state).reset(NOW)
    assert released
    assert state.value in message


@pytest.mark.medium
@settings(max_examples=300, derandomize=True)
@given(events=st.lists(st.sampled_from(sorted(EVENTS)), max_size=30))
def test_only_a_reset_and_then_arm_lead_from_a_latched_state_to_armed(events: list[str]) -> None:
    """After any events, only the event `arm` leads from `disarmed` to `armed`."""
    arming = Arming()
    for event in events:
        before = arming.state
        EVENTS[event](arming)
        if arming.armed and before is not ARMED:
            assert (before, event) == (DISARMED, 'arm')
        if before in (STOPPED, FAULT) and arming.state not in (STOPPED, FAULT):
            assert (arming.state, event) == (DISARMED, 'reset')
