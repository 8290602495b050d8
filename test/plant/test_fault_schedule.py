# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Begin and end of scheduled faults, and refused schedules."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from math import inf, nan, pi
from pathlib import Path
from typing import Any

from fourbar_ros.common.config_files import load_yaml
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
from fourbar_ros.plant.fault_schedule import (
    FaultBoard,
    FaultChange,
    LATEST_S,
    parse_schedule,
    ScheduledFault,
)
from fourbar_ros.plant.faults import Fault, FaultError, SENSOR_FAULTS
import pytest

Refuses = Callable[..., AbstractContextManager[None]]
TARGETS = (*LINK_NAMES, *FLYWHEEL_NAMES)
S = 1_000_000_000
WRONG = {'at': 2.0, 'until': 5.0, 'target': 'link_b', 'fault': 'wrong', 'value': 0.1}
DEAD = {'at': 8.0, 'target': 'flywheel_a', 'fault': 'dead'}


@pytest.fixture
def board() -> FaultBoard:
    """Make a board of four link sensors and four wheels without faults."""
    return FaultBoard(TARGETS)


def entry(**changed: Any) -> dict[str, Any]:
    return {**WRONG, **changed}


def test_entries_are_read() -> None:
    assert parse_schedule([WRONG, DEAD], TARGETS, 'here') == (
        ScheduledFault(Fault('link_b', 'wrong', 0.1), 2 * S, 5 * S),
        ScheduledFault(Fault('flywheel_a', 'dead'), 8 * S, None))


def test_missing_value_is_the_default_of_the_kind() -> None:
    scheduled, = parse_schedule([{**DEAD, 'fault': 'weak'}], TARGETS, 'here')
    assert scheduled.fault == Fault('flywheel_a', 'weak')


def test_off_may_be_written_bare_in_yaml(tmp_path: Path) -> None:
    """YAML 1.1 reads the word as false."""
    path = tmp_path / 'schedule.yaml'
    path.write_text('faults:\n  - {at: 1, target: link_a, fault: off}\n')
    scheduled, = parse_schedule(load_yaml(path)['faults'], TARGETS, 'here')
    assert scheduled.fault == Fault('link_a', 'off')


def test_faults_begin_and_end_at_their_time_to_the_nanosecond(board: FaultBoard) -> None:
    board.load([WRONG], 'here')
    wrong = Fault('link_b', 'wrong', 0.1)
    for elapsed_ns, changes, faults in [
        (0, (), {}),
        (2 * S - 1, (), {}),
        (2 * S, (FaultChange(2 * S, 'link_b', wrong),), {'link_b': wrong}),
        (2 * S + 1, (), {'link_b': wrong}),
        (5 * S - 1, (), {'link_b': wrong}),
        (5 * S, (FaultChange(5 * S, 'link_b', None),), {}),
        (100 * S, (), {}),
    ]:
        assert (board.at_time(elapsed_ns), dict(board.faults)) == (changes, faults)


def test_without_until_a_fault_stays(board: FaultBoard) -> None:
    board.load([DEAD], 'here')
    board.at_time(8 * S)
    board.at_time(10 ** 9 * S)
    assert board.faults == {'flywheel_a': Fault('flywheel_a', 'dead')}


def test_changes_come_in_the_order_of_their_times(board: FaultBoard) -> None:
    """The order depends neither on the interval of the calls nor on the order of the entries."""
    board.load([DEAD, entry(at=4, until=9), entry(at=1, until=4, fault='stuck', value=None),
                entry(target='link_c', at=1, until=None)], 'here')
    assert [(change.elapsed_ns // S, change.target, change.fault and change.fault.kind)
            for change in board.at_time(20 * S)] == [
        (1, 'link_b', 'stuck'), (1, 'link_c', 'wrong'), (4, 'link_b', None),
        (4, 'link_b', 'wrong'), (8, 'flywheel_a', 'dead'), (9, 'link_b', None)]
    assert set(board.faults) == {'flywheel_a', 'link_c'}


def test_fault_set_by_hand_acts_until_it_is_removed(board: FaultBoard) -> None:
    fault = Fault('link_a', 'off')
    board.set_fault('link_a', fault)
    assert board.faults == {'link_a': fault}
    board.set_fault('link_a', None)
    board.set_fault('link_a', None)
    assert not board.faults


def test_scheduled_end_keeps_a_fault_set_by_hand(board: FaultBoard) -> None:
    """The fault set by hand is equal to the scheduled one."""
    board.load([WRONG], 'here')
    board.at_time(3 * S)
    by_hand = Fault('link_b', 'wrong', 0.1)
    board.set_fault('link_b', by_hand)
    assert board.at_time(6 * S) == ()
    assert board.faults == {'link_b': by_hand}


def test_scheduled_end_of_a_fault_removed_by_hand_is_no_change(board: FaultBoard) -> None:
    board.load([WRONG], 'here')
    board.at_time(3 * S)
    board.set_fault('link_b', None)
    assert board.at_time(6 * S) == ()


def test_scheduled_begin_replaces_a_fault_set_by_hand(board: FaultBoard) -> None:
    board.load([WRONG], 'here')
    board.set_fault('link_b', Fault('link_b', 'off'))
    board.at_time(2 * S)
    assert board.faults['link_b'].kind == 'wrong'


def test_new_schedule_replaces_the_old_one(board: FaultBoard) -> None:
    board.load([WRONG, entry(target='link_c', at=10, until=11)], 'here')
    board.at_time(3 * S)
    board.load([DEAD], 'there', 3 * S)
    assert not board.faults
    board.at_time(10 * S)
    assert set(board.faults) == {'flywheel_a'}


def test_refused_schedule_has_no_effect(board: FaultBoard) -> None:
    board.load([WRONG, DEAD], 'here')
    board.at_time(3 * S)
    with pytest.raises(FaultError):
        board.load([entry(at=20, until=21), entry(at=1)], 'there', 3 * S)
    assert set(board.faults) == {'link_b'}
    board.at_time(8 * S)
    assert set(board.faults) == {'flywheel_a'}


def test_faults_are_read_only(board: FaultBoard) -> None:
    with pytest.raises(TypeError):
        board.faults['link_a'] = Fault('link_a', 'off')  # type: ignore[index]


@pytest.mark.parametrize(('changed', 'values'), [
    ({'target': 'link_e'}, {'name': 'target', 'value': 'link_e'}),
    ({'target': 'joint_1'}, {'name': 'target', 'value': 'joint_1', 'limit': TARGETS}),
    ({'target': ['link_a']}, {'name': 'target', 'value': ['link_a']}),
    ({'fault': 'broken'}, {'name': 'link_b', 'value': 'broken', 'limit': tuple(SENSOR_FAULTS)}),
    ({'fault': 'wrong 0.1'}, {'name': 'link_b', 'value': 'wrong 0.1'}),
    ({'fault': ['off']}, {'name': 'link_b', 'value': ['off']}),
    ({'fault': None}, {'name': 'link_b', 'value': None}),
    ({'fault': True}, {'name': 'link_b', 'value': True}),
    ({'value': 4.0}, {'name': 'link_b.wrong', 'value': 4.0, 'limit': (-pi, pi)}),
    ({'value': 'much'}, {'name': 'link_b.wrong', 'value': 'much', 'limit': float}),
    ({'fault': 'intermittent', 'value': 1.5},
     {'name': 'link_b.intermittent', 'value': 1.5, 'limit': (0.0, 1.0)}),
    ({'at': -0.1}, {'name': 'at', 'value': -0.1, 'limit': (0.0, LATEST_S)}),
    ({'at': nan}, {'name': 'at', 'limit': (0.0, LATEST_S)}),
    ({'at': '2'}, {'name': 'at', 'value': '2', 'limit': float}),
    ({'at': None}, {'name': 'at', 'value': None, 'limit': float}),
    ({'at': True}, {'name': 'at', 'value': True, 'limit': float}),
    ({'until': 2.0}, {'name': 'until', 'value': 2.0, 'limit': 2.0}),
    ({'until': 1.9}, {'name': 'until', 'value': 1.9, 'limit': 2.0}),
    ({'until': inf}, {'name': 'until', 'value': inf, 'limit': (0.0, LATEST_S)}),
    ({'til': 3.0}, {'unknown': ['til']}),
])
def test_bad_entry_is_refused_by_its_number(
    changed: dict[str, Any], values: dict[str, Any], refuses: Refuses,
) -> None:
    with refuses(FaultError, place='run.yaml, entry 2', **values):
        parse_schedule([DEAD, entry(**changed)], TARGETS, 'run.yaml')


@pytest.mark.parametrize('key', ['at', 'target', 'fault'])
def test_missing_key_is_named(key: str, refuses: Refuses) -> None:
    lacking = {name: value for name, value in WRONG.items() if name != key}
    with refuses(FaultError, place='run.yaml, entry 1', missing=[key]):
        parse_schedule([lacking], TARGETS, 'run.yaml')


@pytest.mark.parametrize('bad', [3, 'link_a off', None, ['link_a', 'off']])
def test_entry_that_is_no_mapping_is_refused(bad: Any, refuses: Refuses) -> None:
    with refuses(FaultError, entry=1, value=bad, limit=dict):
        parse_schedule([bad], TARGETS, 'run.yaml')


@pytest.mark.parametrize('bad', [WRONG, 'off', None, 3])
def test_schedule_that_is_no_list_is_refused(bad: Any, refuses: Refuses) -> None:
    with refuses(FaultError, place='run.yaml', value=bad, limit=list):
        parse_schedule(bad, TARGETS, 'run.yaml')


def test_entry_in_the_past_is_refused_and_one_at_present_is_not(refuses: Refuses) -> None:
    assert parse_schedule([WRONG], TARGETS, 'here', 2 * S)
    with refuses(FaultError, place='here, entry 1', name='at', value=2.0, limit=2.5):
        parse_schedule([WRONG], TARGETS, 'here', 2 * S + S // 2)


@pytest.mark.parametrize(('at', 'until'), [
    (2.0, 5.0), (1.0, 2.5), (4.999, 6.0), (3.0, 4.0), (1.0, 6.0), (1.0, None), (4.0, None)])
def test_overlap_on_one_target_is_refused_with_both_numbers(
    at: float, until: float | None, refuses: Refuses,
) -> None:
    with refuses(FaultError, entry=3, overlaps=2, name='link_b'):
        parse_schedule([DEAD, WRONG, entry(at=at, until=until)], TARGETS, 'here')


def test_no_fault_may_follow_one_without_end(refuses: Refuses) -> None:
    with refuses(FaultError, entry=2, overlaps=1, name='flywheel_a'):
        parse_schedule([DEAD, {**DEAD, 'at': 100}], TARGETS, 'here')


@pytest.mark.parametrize(('at', 'until'), [(1.0, 2.0), (5.0, 6.0), (5.0, None)])
def test_faults_may_follow_each_other_at_once(at: float, until: float | None) -> None:
    assert len(parse_schedule([WRONG, entry(at=at, until=until)], TARGETS, 'here')) == 2


@pytest.mark.parametrize(('target', 'fault', 'name', 'value'), [
    ('link_e', None, 'target', 'link_e'),
    ('joint_1', Fault('joint_1', 'off'), 'target', 'joint_1'),
    ('link_a', Fault('link_b', 'off'), 'link_a', 'link_b')])
def test_fault_by_hand_of_another_target_is_refused(
    target: str, fault: Fault | None, name: str, value: str, board: FaultBoard, refuses: Refuses,
) -> None:
    with refuses(FaultError, name=name, value=value):
        board.set_fault(target, fault)
    assert not board.faults
