# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The loop closes on both branches, from any two links, and continues across +-pi."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import combinations
from math import acos, inf, isclose, pi

from fourbar_ros.mechanism import (
    assemble,
    branch_of,
    closure_error,
    ClosureError,
    Mechanism,
    nearest_assembly,
    reduced_form,
)
from fourbar_ros.mechanism.change_points import FOLDED_SINE
from fourbar_ros.mechanism.closure import (
    assemble_along,
    BRANCHES,
    check_motion,
    solve_pair,
    TOLERANCE,
    wrap,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Refuses = Callable[..., AbstractContextManager[None]]
PAIRS = tuple(combinations(range(4), 2))

# Angles up to 10 rad and lengths up to 0.5 m have rounding errors of 2e-15 rad and 1e-16 m. The
# arc cosine amplifies by at most 1 / sin(FOLD), and ratios of lengths reach 10. Hence 1e-12.
EXACT = 1e-12
FOLD = 0.05

repeatable = settings(derandomize=True, deadline=None, max_examples=60)


def linkage(lengths: tuple[float, ...]) -> Mechanism:
    """Make a linkage with given lengths; its other parameters have no effect."""
    middle = [[0.5 * length, 0.0] for length in lengths]
    return Mechanism(lengths, [0.02] * 4, [2e-5] * 4, middle, [3e-7] * 4)


@st.composite
def assembled(draw: st.DrawFn) -> tuple[Mechanism, Array, str]:
    """Draw a linkage, its angles away from any fold of a, b or of c, d, and their branch."""
    lengths = draw(st.tuples(*[st.floats(0.05, 0.5)] * 4))
    low = max(abs(lengths[0] - lengths[1]), abs(lengths[2] - lengths[3]))
    high = min(lengths[0] + lengths[1], lengths[2] + lengths[3])
    assume(high - low > 0.05 * high)
    diagonal = low + draw(st.floats(0.05, 0.95)) * (high - low)
    cosine = (lengths[0]**2 + lengths[1]**2 - diagonal**2) / (2 * lengths[0] * lengths[1])
    theta = acos(cosine) * draw(st.sampled_from([-1.0, 1.0]))
    phi_a = draw(st.floats(-10.0, 10.0))
    branch = draw(st.sampled_from(BRANCHES))
    mechanism = linkage(lengths)
    angles = assemble(mechanism, phi_a, phi_a + theta, branch)
    assume(abs(np.sin(angles[3] - angles[2])) > FOLD)
    return mechanism, angles, branch


def distance(first: Array, second: Array) -> float:
    """Return the largest difference of two sets of angles without whole turns [rad]."""
    return float(np.abs((first - second + pi) % (2.0 * pi) - pi).max())


@given(case=assembled())
@repeatable
def test_assembly_closes(case: tuple[Mechanism, Array, str]) -> None:
    mechanism, angles, _ = case
    assert closure_error(mechanism, angles) < EXACT * mechanism.link_lengths.sum()


@given(case=assembled())
@repeatable
def test_assembly_is_on_the_branch_asked_for(case: tuple[Mechanism, Array, str]) -> None:
    _, angles, branch = case
    assert branch_of(angles) == branch


@given(case=assembled())
@repeatable
def test_two_branches_differ(case: tuple[Mechanism, Array, str]) -> None:
    """Joint 3 changes sides, so c and d each turn by twice an angle of their triangle."""
    mechanism, angles, branch = case
    other = assemble(mechanism, *angles[:2], BRANCHES[1 - BRANCHES.index(branch)])
    assert distance(angles, other) > FOLD


@given(case=assembled())
@repeatable
def test_angles_given_are_kept(case: tuple[Mechanism, Array, str]) -> None:
    mechanism, angles, branch = case
    np.testing.assert_array_equal(assemble(mechanism, *angles[:2], branch)[:2], angles[:2])


@pytest.mark.parametrize('pair', PAIRS)
@given(case=assembled())
@repeatable
def test_any_pair_of_links_gives_the_others(
    pair: tuple[int, int], case: tuple[Mechanism, Array, str],
) -> None:
    mechanism, angles, _ = case
    assume(away_from_fold(mechanism, angles, pair))
    solutions = solve_pair(mechanism, pair, tuple(angles[list(pair)]))
    assert min(distance(solution, angles) for solution in solutions) < 1e2 * EXACT


@pytest.mark.parametrize('pair', PAIRS)
@given(case=assembled())
@repeatable
def test_both_solutions_of_a_pair_close(
    pair: tuple[int, int], case: tuple[Mechanism, Array, str],
) -> None:
    mechanism, angles, _ = case
    assume(away_from_fold(mechanism, angles, pair))
    solutions = solve_pair(mechanism, pair, tuple(angles[list(pair)]))
    assert len(solutions) == 2
    for solution in solutions:
        assert closure_error(mechanism, solution) < EXACT * mechanism.link_lengths.sum()


def away_from_fold(mechanism: Mechanism, angles: Array, pair: tuple[int, int]) -> bool:
    """Return whether the other two links are far enough from a line to be well determined."""
    k, m = (index for index in range(4) if index not in pair)
    lengths = mechanism.link_lengths
    sign = 1.0 if (k in (0, 3)) == (m in (0, 3)) else -1.0
    gap = lengths[k] * np.exp(1j * angles[k]) + sign * lengths[m] * np.exp(1j * angles[m])
    return bool(abs(np.sin(angles[k] - angles[m])) > FOLD and abs(gap) > FOLD * lengths.max())


@pytest.mark.parametrize('pair', PAIRS)
@given(case=assembled(), turns=st.floats(-20.0, 20.0))
@repeatable
def test_nearest_assembly_finds_the_linkage_again(
    pair: tuple[int, int], case: tuple[Mechanism, Array, str], turns: float,
) -> None:
    """From angles that are off by less than the way to the other branch, any number of turns."""
    mechanism, angles, _ = case
    angles = angles + turns
    assume(away_from_fold(mechanism, angles, pair))
    near = angles + 0.2 * FOLD * np.array([1.0, -1.0, -1.0, 1.0])
    found = nearest_assembly(mechanism, pair, tuple(angles[list(pair)]), near)
    np.testing.assert_allclose(found, angles, rtol=0.0, atol=1e2 * EXACT)


@pytest.mark.parametrize('pair', PAIRS)
@pytest.mark.parametrize('branch', BRANCHES)
def test_nearest_assembly_is_continuous_over_whole_turns(
    pair: tuple[int, int], branch: str,
) -> None:
    """A rigid turn moves every angle by the same amount, past +-pi and on."""
    mechanism = linkage((0.12, 0.1, 0.11, 0.09))
    start = assemble(mechanism, 0.3, 1.4, branch)
    angles, turn = start, 0.0
    while turn < 4.5 * pi:
        turn += 0.05
        known = start[list(pair)] + turn
        angles = nearest_assembly(mechanism, pair, tuple(known), angles)
        np.testing.assert_allclose(angles, start + turn, rtol=0.0, atol=1e2 * EXACT)


@pytest.mark.parametrize('theta', [0.01, 0.5, pi / 2, 3.0, -0.7, -3.1])
def test_open_parallelogram_has_parallel_sides(theta: float) -> None:
    angles = assemble(linkage((0.15, 0.08, 0.15, 0.08)), 0.4, 0.4 + theta, 'open')
    assert distance(angles[2:], angles[:2]) < 1e-12


def test_crossed_parallelogram_has_not() -> None:
    angles = assemble(linkage((0.15, 0.08, 0.15, 0.08)), 0.4, 1.4, 'crossed')
    assert distance(angles[2:], angles[:2]) > 0.1


@pytest.mark.parametrize('branch', BRANCHES)
@pytest.mark.parametrize('theta', [0.0, pi])
def test_branches_meet_where_the_parallelogram_is_folded(theta: float, branch: str) -> None:
    """There c and d lie on a line: both names give the one assembly."""
    angles = assemble(linkage((0.15, 0.08, 0.15, 0.08)), 0.4, 0.4 + theta, branch)
    # The error of an arc cosine at its end is the square root of that of its argument.
    assert distance(angles[2:], angles[:2]) < 1e-7


def test_unknown_branch_is_refused(refuses: Refuses) -> None:
    with refuses(ClosureError, name='branch', value='folded', limit=BRANCHES):
        assemble(linkage((0.1,) * 4), 0.0, 1.0, 'folded')


def test_configuration_out_of_reach_is_refused(refuses: Refuses) -> None:
    with refuses(ClosureError, value=0.6, limit=(0.0, 0.2)):
        assemble(linkage((0.3, 0.3, 0.1, 0.1)), 0.0, pi)


@pytest.mark.parametrize(('pair', 'names'), [
    ((0, 2), ('link_a', 'link_c')), ((1, 3), ('link_b', 'link_d'))])
def test_opposite_links_of_a_parallelogram_do_not_determine_it(
    pair: tuple[int, int], names: tuple[str, str], refuses: Refuses,
) -> None:
    with refuses(ClosureError, undetermined=names):
        solve_pair(linkage((0.15, 0.08, 0.15, 0.08)), pair, (0.5, 0.5))


def test_folded_rhombus_is_not_determined_by_a_and_b(refuses: Refuses) -> None:
    with refuses(ClosureError, undetermined=('link_a', 'link_b')):
        assemble(linkage((0.1,) * 4), 0.5, 0.5)


@given(phi_a=st.floats(-10.0, 10.0), theta=st.floats(0.1, 3.0))
@repeatable
def test_closure_error_is_the_gap_that_a_wrong_angle_leaves(phi_a: float, theta: float) -> None:
    """Turning link c alone by x moves its end along a chord, 2 l sin(x / 2)."""
    mechanism = linkage((0.1,) * 4)
    angles = assemble(mechanism, phi_a, phi_a + theta)
    angles[2] += 0.2
    assert isclose(closure_error(mechanism, angles), 0.2 * np.sin(0.1), abs_tol=EXACT)


@given(angle=st.floats(-1e3, 1e3))
@repeatable
def test_wrapped_angle_lies_in_one_turn(angle: float) -> None:
    assert -pi < wrap(angle) <= pi


@pytest.mark.parametrize('turns', range(-9, 10))
@pytest.mark.parametrize('towards', [-inf, 0.0, inf])
def test_angle_beside_half_a_turn_is_wrapped_into_it(turns: int, towards: float) -> None:
    angle = (2 * turns + 1) * pi
    if towards:
        angle = float(np.nextafter(angle, towards))
    assert -pi < wrap(angle) <= pi


@given(angle=st.floats(-1e3, 1e3))
@repeatable
def test_wrapping_takes_off_whole_turns(angle: float) -> None:
    turns = (angle - wrap(angle)) / (2.0 * pi)
    assert isclose(turns, round(turns), abs_tol=1e-12)


@pytest.mark.parametrize('branch', BRANCHES)
@pytest.mark.parametrize('phi_a', [-1.0, 0.0, 1.0])
@pytest.mark.parametrize('phi_b', [-pi, 0.5, 2.0, pi])
def test_angles_worked_out_lie_in_one_turn(phi_a: float, phi_b: float, branch: str) -> None:
    angles = assemble(linkage((0.1,) * 4), phi_a, phi_b, branch)
    assert -pi < angles[2] <= pi
    assert -pi < angles[3] <= pi


@pytest.mark.slow
@given(drawn=assembled(), turn=st.floats(-20.0, 20.0), change=st.floats(-0.02, 0.02))
@repeatable
def test_path_is_followed_as_step_by_step(
    drawn: tuple[Mechanism, Array, str], turn: float, change: float,
) -> None:
    """Turn by several turns while the configuration changes a little."""
    mechanism, start, _ = drawn
    share = np.linspace(0.0, 1.0, 300)
    phi_a, phi_b = start[0] + turn * share, start[1] + (turn + change) * share
    followed = assemble_along(mechanism, phi_a, phi_b, start)
    angles = start
    for n in range(share.size):
        angles = nearest_assembly(mechanism, (0, 1), (phi_a[n], phi_b[n]), angles)
        np.testing.assert_allclose(followed[n], angles, rtol=0.0, atol=20.0 * EXACT)


def test_path_that_opens_the_loop_is_refused_where_it_does(refuses: Refuses) -> None:
    mechanism = linkage((0.3, 0.2, 0.2, 0.2))
    start = assemble(mechanism, 0.0, 1.0)
    path = np.linspace(1.0, pi, 50)
    gaps = np.hypot(0.3 - 0.2 * np.cos(path), 0.2 * np.sin(path))
    first = float(gaps[np.argmax(gaps > 0.4)])
    with refuses(ClosureError, value=pytest.approx(first, rel=1e-12), limit=(0.0, 0.4)):
        assemble_along(mechanism, np.zeros(50), path, start)


# --- Folded -----------------------------------------------------------------------------------

@pytest.mark.parametrize('turns', [0.0, 2.0 * pi, -6.0 * pi])
@pytest.mark.parametrize('apart', [1e-5, 0.3, -1.0, 3.0])
@pytest.mark.parametrize('angle', [0.0, 0.7, -2.0])
def test_two_pairs_of_links_on_each_other_are_folded(
    angle: float, apart: float, turns: float,
) -> None:
    """Joint 4 lies on joint 2, which is a motion of its own where l_a = l_b and l_c = l_d."""
    angles = np.array([angle, angle, angle + apart, angle + apart]) + [0.0, turns, 0.0, -turns]
    assert closure_error(linkage((0.15, 0.15, 0.08, 0.08)), angles) < EXACT
    assert branch_of(angles) == 'folded'


@pytest.mark.parametrize('theta', [0.0, pi, -pi, 2.0 * pi])
def test_change_point_itself_is_not_folded(theta: float) -> None:
    """All branches meet there."""
    assert branch_of([0.4, 0.4 + theta, 0.4, 0.4 + theta]) == 'open'


@pytest.mark.parametrize(('within', 'branch'), [(0.5, 'folded'), (2.0, 'crossed')])
def test_fold_is_one_up_to_a_small_angle(within: float, branch: str) -> None:
    """In a linkage that does not quite match the pairs lie on each other only nearly."""
    small = within * FOLDED_SINE
    assert branch_of([0.0, small, 1.0, 1.0 - small]) == branch


# --- Possible motions -------------------------------------------------------------------------

@given(case=assembled(), rates=st.tuples(*[st.floats(-5.0, 5.0)] * 2))
@repeatable
def test_motion_on_the_closure_is_accepted(
    case: tuple[Mechanism, Array, str], rates: tuple[float, float],
) -> None:
    mechanism, angles, _ = case
    gamma = reduced_form(mechanism, angles, rates).gamma
    check_motion(mechanism, angles, [*rates, *(gamma @ rates)])


@contextmanager
def refused_by(gap: float, limit: float) -> Iterator[None]:
    """Expect a refusal with these values, in three digits."""
    with pytest.raises(ClosureError) as refusal:
        yield
    values = refusal.value.values
    assert (values['value'], values['limit']) == pytest.approx((gap, limit), rel=6e-3)


@given(phi_a=st.floats(-10.0, 10.0), theta=st.floats(0.1, 3.0), link=st.sampled_from(range(4)))
@repeatable
def test_gap_is_accepted_up_to_its_limit(phi_a: float, theta: float, link: int) -> None:
    """One link of a rhombus turned by x opens it by x times its length."""
    mechanism = linkage((0.1,) * 4)
    angles = assemble(mechanism, phi_a, phi_a + theta)
    turned = np.eye(4)[link] * TOLERANCE
    check_motion(mechanism, angles + 0.99 * turned, np.zeros(4))
    with refused_by(1.01e-7, 1e-7):
        check_motion(mechanism, angles + 1.01 * turned, np.zeros(4))


@given(phi_a=st.floats(-10.0, 10.0), theta=st.floats(0.1, 3.0), link=st.sampled_from(range(4)))
@repeatable
def test_opening_is_accepted_up_to_its_limit(phi_a: float, theta: float, link: int) -> None:
    """A rigid turn of the whole opens nothing, one link faster by x opens it by x its length."""
    mechanism = linkage((0.1,) * 4)
    angles = assemble(mechanism, phi_a, phi_a + theta)
    faster = np.eye(4)[link] * TOLERANCE
    check_motion(mechanism, angles, 3.0 + 0.99 * faster)
    with refused_by(1.01e-7, 1e-7):
        check_motion(mechanism, angles, 3.0 + 1.01 * faster)


def test_limit_is_relative_to_the_longest_link() -> None:
    mechanism = linkage((40.0, 10.0, 40.0, 10.0))
    angles = assemble(mechanism, 0.0, 1.0)
    with refused_by(0.1, 4e-5):
        check_motion(mechanism, angles + [0.0, 0.01, 0.0, 0.0], np.zeros(4))


@pytest.mark.parametrize('value', [np.nan, inf, -inf])
@pytest.mark.parametrize('link', range(4))
def test_state_that_is_not_finite_is_refused_with_the_link(
    link: int, value: float, refuses: Refuses,
) -> None:
    mechanism = linkage((0.1,) * 4)
    sound, broken = np.array([0.0, 1.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0, 1.0])
    broken[link] = value
    name = f'link_{"abcd"[link]}'
    for place, angles, rates in (('link_angles', broken, np.zeros(4)),
                                 ('link_rates', sound, broken)):
        same = pytest.approx(value, nan_ok=True)
        with refuses(ClosureError, name=f'{place}.{name}', value=same):
            check_motion(mechanism, angles, rates)
