# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Conditioning over configurations against Kane's method, singular values, and by hand."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from itertools import combinations

from fourbar_ros.mechanism import assemble, ClosureError, load_mechanism, Mechanism
from fourbar_ros.mechanism.closure import BRANCHES, closure_error, SIGNS
from fourbar_ros.mechanism.conditioning import conditioning_grid, motions, WHEELS
from fourbar_ros.mechanism.dynamics import mass_matrix
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Mechanism]
SEEDS = range(12)
# Configurations without 0, where branches have no names [rad].
THETAS = np.linspace(-3.0, 3.0, 24)


def closure_jacobian(mechanism: Mechanism, angles: Array) -> Array:
    """Return the closure Jacobian J (2, 4)."""
    signed = np.array(SIGNS) * mechanism.link_lengths
    return np.array([-signed * np.sin(angles), signed * np.cos(angles)])


def configurations(linkage: Mechanism, branch: str) -> dict[int, Array]:
    """Return link angles by index of theta, where the linkage closes."""
    found = {}
    for index, theta in enumerate(THETAS):
        try:
            found[index] = assemble(linkage, 0.0, theta, branch)
        except ClosureError:
            continue
    return found


@pytest.mark.parametrize('branch', BRANCHES)
@pytest.mark.parametrize('seed', SEEDS)
def test_any_linkage_against_singular_values(
    seed: int, branch: str, random_linkage: Draw,
) -> None:
    """The reference is the SVD of J and the mass matrix; values are NaN where it cannot close."""
    linkage = random_linkage(np.random.default_rng(seed))
    found = conditioning_grid([linkage], THETAS, branch)
    closed = configurations(linkage, branch)
    assert set(np.flatnonzero(np.isfinite(found.closure_ratio[0]))) == set(closed), f'seed {seed}'
    roots = np.sqrt(linkage.flywheel_inertias / linkage.flywheel_inertias.max())
    for index, angles in closed.items():
        _, singular, rows = np.linalg.svd(closure_jacobian(linkage, angles))
        basis = rows[2:].T
        inertia = mass_matrix(angles, linkage.constants)
        # Motions of unit rates of a and b, the basis of paper eq. 6.
        of_axes = basis @ np.linalg.inv(basis[:2])
        case = f'seed {seed}, theta {THETAS[index]}'
        assert found.closure_ratio[0, index] == pytest.approx(singular[1] / singular[0]), case
        assert found.alignment[0, index] == pytest.approx(abs(np.sin(angles[3] - angles[2]))), case
        assert found.condition_of_motions[0, index] == pytest.approx(
            np.linalg.cond(basis.T @ inertia @ basis)), case
        assert found.condition[0, index] == pytest.approx(
            np.linalg.cond(of_axes.T @ inertia @ of_axes), rel=1e-7), case
        for left, gain in zip(WHEELS, found.gains[0, index], strict=True):
            wanted = np.linalg.svd(basis.T * (roots * left), compute_uv=False)[1]
            assert gain == pytest.approx(wanted, abs=1e-9), (case, left)


@pytest.mark.medium
@pytest.mark.parametrize('seed', SEEDS)
def test_condition_is_that_of_kanes_method(seed: int, random_linkage: Draw) -> None:
    """The reference is the mass matrix by SymPy, with translation and c, d eliminated."""
    pytest.importorskip('sympy')
    from fourbar_ros.studies.independent import kane

    linkage = random_linkage(np.random.default_rng(seed))
    closed = configurations(linkage, 'open')
    index = list(closed)[len(closed) // 2]
    # Locked wheels without inertia leave the inertia of the links.
    parameters = [*kane.parameters_of(linkage)[:20], *(0.0,) * 4]
    matrix = np.array(kane.derive_equations((True,) * 4).evaluate(
        closed[index], np.zeros(4), np.zeros(4), parameters)[0])
    gamma = -np.linalg.solve(matrix[4:, 4:], matrix[4:, :4])
    speeds = matrix[:4, :4] + matrix[:4, 4:] @ gamma
    reduced = speeds[2:, 2:] - speeds[2:, :2] @ np.linalg.solve(speeds[:2, :2], speeds[:2, 2:])
    found = conditioning_grid([linkage], THETAS).condition[0, index]
    assert found == pytest.approx(np.linalg.cond(reduced), rel=1e-8), f'seed {seed}'


@pytest.mark.parametrize('seed', SEEDS)
def test_motions_do_not_depend_on_which_links_are_the_axes(
    seed: int, random_linkage: Draw,
) -> None:
    """
    The mirror image exchanges a with b and c with d.

    Its cond(A) is the same. With the axes c and d, only the condition of the motions is the same.
    """
    linkage = random_linkage(np.random.default_rng(seed))
    order = [2, 3, 0, 1]
    # The frames of links c and d begin at joint 3.
    around = Mechanism(
        linkage.link_lengths[order], linkage.link_masses[order], linkage.link_inertias[order],
        np.column_stack([linkage.link_lengths - linkage.com_positions[:, 0],
                         -linkage.com_positions[:, 1]])[order], linkage.flywheel_inertias[order])
    checked, differs = 0, False
    for branch in BRANCHES:
        found = conditioning_grid([linkage], THETAS, branch)
        for index, angles in configurations(linkage, branch).items():
            turned = (angles + np.pi)[order]
            assert closure_error(around, turned) < 1e-9
            again = conditioning_grid([around], [turned[1] - turned[0]], branch)
            assert again.condition_of_motions[0, 0] == pytest.approx(
                found.condition_of_motions[0, index], rel=1e-6), f'seed {seed}'
            assert again.closure_ratio[0, 0] == pytest.approx(
                found.closure_ratio[0, index], rel=1e-6), f'seed {seed}'
            differs |= abs(again.condition[0, 0] / found.condition[0, index] - 1.0) > 0.1
            checked += 1
    assert checked > 5
    assert differs


def test_rhombus_by_hand() -> None:
    """J J^T has the eigenvalues `2 l^2 (1 +- cos theta)`; a turns with c and b with d."""
    thetas = np.array([1e-5, 1e-3, 0.3, 1.0, np.pi / 2.0, 2.0, 3.0])
    found = conditioning_grid([load_mechanism('paper')], thetas)
    half = np.tan(0.5 * thetas)
    # Rounding of angles is amplified by 1 / theta.
    np.testing.assert_allclose(found.closure_ratio[0], np.minimum(half, 1.0 / half), rtol=1e-6)
    np.testing.assert_allclose(found.alignment[0], np.sin(thetas), rtol=1e-6)
    np.testing.assert_allclose(found.condition_of_motions, 1.0, rtol=1e-6)
    for row, wheels in enumerate([(0, 1, 2, 3), (1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2),
                                  *combinations(range(4), 2)]):
        assert set(np.flatnonzero(WHEELS[row])) == set(wheels)
        pairs = [sum(wheel % 2 == pair for wheel in wheels) for pair in (0, 1)]
        np.testing.assert_allclose(found.gains[0, :, row], np.sqrt(0.5 * min(pairs)), atol=1e-6)


def test_change_point_is_nan() -> None:
    found = conditioning_grid([load_mechanism('paper')], [0.0])
    assert np.isnan(found.condition).all()
    assert np.isnan(found.gains).all()


def test_small_singular_values_keep_their_digits() -> None:
    """The basis of the motions is exact next to a change point, where J J^T is singular."""
    for theta in (1e-5, 1e-8, 1e-11):
        x = (-1.0, np.cos(theta), 1.0, -np.cos(theta))
        y = (0.0, np.sin(theta), 0.0, -np.sin(theta))
        first, second, determinant = motions(x, y)
        # Links a and c move together, and b and d.
        np.testing.assert_allclose((first[2:], second[2:]), (first[:2], second[:2]), atol=1e-12)
        np.testing.assert_allclose([first @ first, first @ second, second @ second],
                                   [1.0, 0.0, 1.0], atol=1e-12)
        assert determinant == pytest.approx(4.0 * np.sin(theta) ** 2, rel=1e-9)


def test_unknown_branch_is_refused(refuses: Callable[..., AbstractContextManager[None]]) -> None:
    with refuses(ClosureError, name='branch', value='folded'):
        conditioning_grid([load_mechanism('paper')], [1.0], 'folded')
