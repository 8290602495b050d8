# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Faults come and go at their time, and a schedule that cannot be followed is refused."""

from collections.abc import Callable
from math import inf, nan
from pathlib import Path
from typing import Any

from fourbar_ros.common.config_files import load_yaml
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
from fourbar_ros.plant.fault_schedule import (
    FaultBoard,
    FaultChange,
    parse_schedule,
    ScheduledFault,
)
from fourbar_ros.plant.faults import Fault, FaultError
import pytest

TARGETS = (*LINK_NAMES, *FLYWHEEL_NAMES)
S = 1_000_000_000
WRONG = {'at': 2.0, 'until': 5.0, 'target': 'link_b', 'fault': 'wrong', 'value': 0.1}
DEAD = {'at': 8.0, 'target': 'flywheel_a', 'fault': 'dead'}


@pytest.fixture
def board() -> FaultBoard:
    """Make a board of four link sensors and four wheels, all well."""
    return FaultBoard(TARGETS)


def entry(**changed: Any) -> dict[str, Any]:
    return {**WRONG, **changed}


def test_entries_arrive() -> None:
    assert parse_schedule([WRONG, DEAD], TARGETS, 'here') == (
        ScheduledFault(Fault('link_b', 'wrong', 0.1), 2 * S, 5 * S),
        ScheduledFault(Fault('flywheel_a', 'dead'), 8 * S, None))


def test_without_a_value_the_kind_has_one() -> None:
    scheduled, = parse_schedule([{**DEAD, 'fault': 'weak'}], TARGETS, 'here')
    assert scheduled.fault == Fault('flywheel_a', 'weak')


def test_off_may_be_written_bare_in_yaml(tmp_path: Path) -> None:
    """YAML 1.1 takes the word for false."""
    path = tmp_path / 'schedule.yaml'
    path.write_text('faults:\n  - {at: 1, target: link_a, fault: off}\n')
    scheduled, = parse_schedule(load_yaml(path)['faults'], TARGETS, 'here')
    assert scheduled.fault == Fault('link_a', 'off')


def test_faults_come_and_go_at_their_time_to_the_nanosecond(board: FaultBoard) -> None:
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
    """However long nobody asked, and however the entries are sorted."""
    board.load([DEAD, entry(at=4, until=9), entry(at=1, until=4, fault='stuck', value=None),
                entry(target='link_c', at=1, until=None)], 'here')
    assert [(change.elapsed_ns // S, change.target, change.fault and change.fault.kind)
            for change in board.at_time(20 * S)] == [
        (1, 'link_b', 'stuck'), (1, 'link_c', 'wrong'), (4, 'link_b', None),
        (4, 'link_b', 'wrong'), (8, 'flywheel_a', 'dead'), (9, 'link_b', None)]
    assert set(board.faults) == {'flywheel_a', 'link_c'}


def test_a_fault_set_by_hand_counts_at_once_until_it_is_taken_away(board: FaultBoard) -> None:
    fault = Fault('link_a', 'off')
    board.set_fault('link_a', fault)
    assert board.faults == {'link_a': fault}
    board.set_fault('link_a', None)
    board.set_fault('link_a', None)
    assert not board.faults


def test_scheduled_end_leaves_what_was_set_by_hand_meanwhile(board: FaultBoard) -> None:
    """Even if it is the same once more."""
    board.load([WRONG], 'here')
    board.at_time(3 * S)
    by_hand = Fault('link_b', 'wrong', 0.1)
    board.set_fault('link_b', by_hand)
    assert board.at_time(6 * S) == ()
    assert board.faults == {'link_b': by_hand}


def test_scheduled_end_of_what_was_mended_by_hand_is_no_change(board: FaultBoard) -> None:
    board.load([WRONG], 'here')
    board.at_time(3 * S)
    board.set_fault('link_b', None)
    assert board.at_time(6 * S) == ()


def test_scheduled_beginning_replaces_what_was_set_by_hand(board: FaultBoard) -> None:
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


def test_refused_schedule_changes_nothing(board: FaultBoard) -> None:
    board.load([WRONG, DEAD], 'here')
    board.at_time(3 * S)
    with pytest.raises(FaultError):
        board.load([entry(at=20, until=21), entry(at=1)], 'there', 3 * S)
    assert set(board.faults) == {'link_b'}
    board.at_time(8 * S)
    assert set(board.faults) == {'flywheel_a'}


def test_faults_can_be_seen_but_not_written(board: FaultBoard) -> None:
    with pytest.raises(TypeError):
        board.faults['link_a'] = Fault('link_a', 'off')  # type: ignore[index]


@pytest.mark.parametrize(('changed', 'message'), [
    ({'target': 'link_e'}, "'link_e'.*known are link_a"),
    ({'target': 'joint_1'}, 'no joint_1 here .*there are link_a, '),
    ({'target': ['link_a']}, 'nothing to break'),
    ({'fault': 'broken'}, "unknown fault 'broken' of link_b .*known are off, stuck"),
    ({'fault': 'wrong 0.1'}, "unknown fault 'wrong 0.1'"),
    ({'fault': ['off']}, 'unknown fault'),
    ({'fault': None}, 'unknown fault None'),
    ({'fault': True}, 'unknown fault True'),
    ({'value': 4.0}, 'angle of wrong of link_b must be from -3.14159 to 3.14159 rad, got 4'),
    ({'value': 'much'}, "must be a number, got 'much'"),
    ({'fault': 'intermittent', 'value': 1.5}, 'probability of .* 0 to 1, got 1.5'),
    ({'at': -0.1}, 'at must be from 0 to 1e.09 s, got -0.1'),
    ({'at': nan}, 'at must be from 0 to .* got nan'),
    ({'at': '2'}, "at must be a number of seconds, got '2'"),
    ({'at': None}, 'at must be a number of seconds, got None'),
    ({'at': True}, 'at must be a number of seconds, got True'),
    ({'until': 2.0}, 'until 2.0 s must be later than at 2.0 s'),
    ({'until': 1.9}, 'until 1.9 s must be later than at 2.0 s'),
    ({'until': inf}, 'until must be from 0 to .* got inf'),
    ({'til': 3.0}, 'unknown til .*known are at, fault, target, until, value'),
])
def test_bad_entry_is_refused_by_its_number(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(FaultError, match=f'^run.yaml, entry 2: .*{message}'):
        parse_schedule([DEAD, entry(**changed)], TARGETS, 'run.yaml')


@pytest.mark.parametrize('key', ['at', 'target', 'fault'])
def test_missing_key_is_named(key: str) -> None:
    lacking = {name: value for name, value in WRONG.items() if name != key}
    with pytest.raises(FaultError, match=f'^run.yaml, entry 1: {key} missing$'):
        parse_schedule([lacking], TARGETS, 'run.yaml')


@pytest.mark.parametrize('bad', [3, 'link_a off', None, ['link_a', 'off']])
def test_entry_that_is_no_mapping_is_refused(bad: Any) -> None:
    with pytest.raises(FaultError, match='entry 1 must be a mapping with at, target and fault'):
        parse_schedule([bad], TARGETS, 'run.yaml')


@pytest.mark.parametrize('bad', [WRONG, 'off', None, 3])
def test_schedule_that_is_no_list_is_refused(bad: Any) -> None:
    with pytest.raises(FaultError, match='^run.yaml: a schedule of faults must be a list'):
        parse_schedule(bad, TARGETS, 'run.yaml')


def test_past_is_refused_and_now_is_not() -> None:
    assert parse_schedule([WRONG], TARGETS, 'here', 2 * S)
    with pytest.raises(FaultError, match='entry 1: at 2.0 s lies in the past, it is 2.5 s now'):
        parse_schedule([WRONG], TARGETS, 'here', 2 * S + S // 2)


@pytest.mark.parametrize(('at', 'until'), [
    (2.0, 5.0), (1.0, 2.5), (4.999, 6.0), (3.0, 4.0), (1.0, 6.0), (1.0, None), (4.0, None)])
def test_overlap_on_one_target_is_refused_with_both_numbers(
    at: float, until: float | None,
) -> None:
    with pytest.raises(FaultError, match='entry 3: overlaps with entry 2 on link_b'):
        parse_schedule([DEAD, WRONG, entry(at=at, until=until)], TARGETS, 'here')


def test_nothing_may_follow_what_stays_for_ever() -> None:
    with pytest.raises(FaultError, match='entry 2: overlaps with entry 1 on flywheel_a'):
        parse_schedule([DEAD, {**DEAD, 'at': 100}], TARGETS, 'here')


@pytest.mark.parametrize(('at', 'until'), [(1.0, 2.0), (5.0, 6.0), (5.0, None)])
def test_faults_may_follow_each_other_at_once(at: float, until: float | None) -> None:
    assert len(parse_schedule([WRONG, entry(at=at, until=until)], TARGETS, 'here')) == 2


@pytest.mark.parametrize(('action', 'message'), [
    (lambda board: board.set_fault('link_e', None), "'link_e'"),
    (lambda board: board.set_fault('joint_1', Fault('joint_1', 'off')), 'no joint_1 here'),
    (lambda board: board.set_fault('link_a', Fault('link_b', 'off')), 'link_b cannot be one of'),
])
def test_fault_by_hand_of_something_else_is_refused(
    action: Callable[[FaultBoard], None], message: str, board: FaultBoard,
) -> None:
    with pytest.raises(FaultError, match=message):
        action(board)
    assert not board.faults
