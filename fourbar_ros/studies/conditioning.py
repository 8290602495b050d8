# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Condition number of the mass matrix over lengths and offsets (paper section 5, Fig. 6).

The condition number of the 2x2 mass matrix of eq. 6 over configurations: of parallelograms by the
ratio of their lengths, and of rhombi whose mass centres are off their links. The study also shows
the distance to a change point and the gains of the wheels, which cond(A) does not indicate.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

from fourbar_ros.common.checks import at_most, Check, finite_or_none, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.mechanism import load_mechanism, reduced_form
from fourbar_ros.mechanism.closure import BRANCHES
from fourbar_ros.mechanism.conditioning import Conditioning, conditioning_grid, WHEELS
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies import figures, Result
from fourbar_ros.studies.conditioning_linkages import (
    condition,
    LENGTH,
    linkage_conditioning,
    LinkageConditioning,
    offset_grid,
    OFFSETS,
    parallelogram,
    POINTS,
    ratio_grid,
    RATIOS,
    rhombus,
    SIGNS,
    span,
    SQUARE,
    STABLE,
    THETAS,
    uniform_links,
    worst_of_three,
)
import numpy as np

TITLES = {'same': 'the same in every body frame', 'inside': 'towards the inside'}
ALL_SIGNS = tuple((1.0, *others) for others in product((1.0, -1.0), repeat=3))

# Known values of cond(A) from an independent model, to the digits shown.
OF_RATIO = {0.25: 2.8657, 0.5: 2.0870, 1.0: 1.0, 2.0: 3.0833, 4.0: 11.4167}
SMALL = 0.3
OF_OFFSET = {('same', 0.02): (1.1059, 1.0), ('same', 0.04): (1.4204, 1.0),
             ('inside', 0.02): (1.3468, 3.0), ('inside', 0.04): (1.5884, 7.6667)}
"""At theta of 0.3 rad, and at 90 deg."""
DIGITS, EXACT = 5e-5, 1e-9
DIAGONAL = 1.44e-4

SPAN_THETAS = np.radians([10.0, 20.0, 30.0, 60.0, 90.0])

# Relative excess length of link a of the linkage that is compared with equal links.
MISMATCH = 0.01
NEAR = np.radians(np.linspace(-40.0, 40.0, 801)[1::2])
AROUND = np.radians(np.linspace(-180.0, 180.0, 1441)[1::2])


def run(progress: Progress, mechanism: str | None = None) -> Result:
    """
    Evaluate the grids of Fig. 6, and linkages near a change point.

    :param mechanism: preset or file of a further linkage.
    :raises FourbarError: there is no such mechanism, or it cannot exist.
    """
    further = None if mechanism is None else load_mechanism(mechanism)
    # The first call compiles.
    conditioning_grid([parallelogram(1.0)], THETAS)
    begin = perf_counter()
    grids = {'ratio': ratio_grid()}
    seconds = perf_counter() - begin
    for name in progress(SIGNS, len(SIGNS)):
        grids[name] = offset_grid(SIGNS[name])
    mismatched = uniform_links(LENGTH * np.array([1.0 + MISMATCH, 1.0, 1.0, 1.0]))
    near = [linkage_conditioning('equal links', parallelogram(1.0), NEAR),
            linkage_conditioning(f'link a longer by {100.0 * MISMATCH:g} %', mismatched, NEAR)]
    files: dict[str, str | bytes] = {
        'conditioning_ratio.csv': _grid_csv('ratio', RATIOS, grids['ratio']),
        **{f'conditioning_offset_{name}.csv': _grid_csv('offset_m', OFFSETS, grids[name])
           for name in SIGNS},
        'conditioning_hidden.csv': _linkages_csv(near)}
    linkages = []
    if further is not None:
        linkages.append(linkage_conditioning(Path(str(mechanism)).stem, further, AROUND, BRANCHES))
        files['conditioning_linkage.csv'] = _linkages_csv(linkages)
    spans = {name: [span(signs, theta) for theta in SPAN_THETAS] for name, signs in SIGNS.items()}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.conditioning_figure import linkages_png, png
        files['conditioning.png'] = png(grids)
        files['conditioning_hidden.png'] = linkages_png(near)
        if linkages:
            files['conditioning_linkage.png'] = linkages_png(linkages)
    return Result(_checks(grids), _data(spans, seconds, linkages), _table(spans, linkages), files,
                  skipped)


def columns(conditioning: Conditioning) -> dict[str, Array]:
    """Return the quantities of the CSV, (m, n) by name of the column."""
    pairs = {f'gain_wheels_{"".join(letter for letter, used in zip("abcd", row) if used)}':
             conditioning.gains[..., place] for place, row in enumerate(WHEELS) if place > 4}
    return {
        'cond_a': conditioning.condition, 'cond_of_motions': conditioning.condition_of_motions,
        'alignment': conditioning.alignment, 'closure_ratio': conditioning.closure_ratio,
        'gain_four_wheels': conditioning.gains[..., 0],
        'gain_three_wheels_worst': worst_of_three(conditioning), **pairs}


def asymmetry() -> float:
    """Return the largest relative change of cond(A) with the sign of all offsets."""
    largest = 0.0
    for signs in ALL_SIGNS:
        values = offset_grid(signs).condition
        largest = max(largest, float((np.abs(values - values[::-1]) / values).max()))
    return largest


def _checks(grids: Mapping[str, Conditioning]) -> list[Check]:
    paper = load_mechanism('paper')
    forms = [reduced_form(paper, [0.0, theta, 0.0, theta], [1.0, -2.0]) for theta in THETAS]
    ideal = conditioning_grid([parallelogram(1.0)], THETAS).condition
    checks = [
        at_most('identical links: A beside diag(1.44e-4)', max(
            float(np.abs(form.mass_matrix - DIAGONAL * np.eye(2)).max()) for form in forms),
            'kg m^2', EXACT * DIAGONAL),
        at_most('identical links: b', max(float(np.abs(form.bias).max()) for form in forms),
                'N m', EXACT * DIAGONAL),
        at_most('identical links: cond A beside 1', float(np.abs(ideal - 1.0).max()), '', EXACT)]
    for ratio, known in OF_RATIO.items():
        values = conditioning_grid([parallelogram(ratio)], THETAS).condition
        checks.append(within(f'cond A, l_a / l_b = {ratio:g}', float(values.mean()), '',
                             known - DIGITS, known + DIGITS))
    of_ratio = grids['ratio'].condition
    checks.append(at_most('cond A of parallelograms, change with theta, relative', float(
        (np.ptp(of_ratio, axis=1) / of_ratio.mean(axis=1)).max()), '', EXACT))
    checks += [
        within(f'cond A, offset {1e3 * offset:g} mm {TITLES[name]}, theta = {theta:.4g} rad',
               condition(rhombus(SIGNS[name], offset), theta), '', known - DIGITS, known + DIGITS)
        for (name, offset), pair in OF_OFFSET.items()
        for theta, known in zip((SMALL, SQUARE), pair)]
    checks.append(at_most(
        'all eight sign conventions: cond A, change with the sign of the offset, relative',
        asymmetry(), '', EXACT))
    return checks


def _data(spans: Mapping[str, list[float]], seconds: float,
          linkages: list[LinkageConditioning]) -> dict[str, Any]:
    by_ratio = {key: {f'{ratio:g}': condition(parallelogram(ratio, with_length), SQUARE)
                      for ratio in OF_RATIO} for key, with_length in (
        ('cond_of_ratio', False), ('cond_of_ratio_mass_with_length', True))}
    return {
        'grid_points': POINTS * POINTS, 'grid_seconds': seconds, **by_ratio,
        'stable_cond': STABLE,
        'stable_offset_m': {name: {f'{theta:g}_deg': finite_or_none(value) for theta, value in zip(
            np.degrees(SPAN_THETAS).round(9), values)} for name, values in spans.items()},
        'linkages': {linkage.title: {branch: _extremes(linkage, branch)
                                     for branch in linkage.branches} for linkage in linkages}}


def _extremes(linkage: LinkageConditioning, branch: str) -> dict[str, Any]:
    """Return the largest condition numbers, the smallest other quantities, and their thetas."""
    conditioning = linkage.branches[branch]
    closed = np.isfinite(conditioning.closure_ratio[0])
    extremes: dict[str, Any] = {'closes_share': float(closed.mean())}
    for name, (values, *_) in columns(conditioning).items():
        if np.isfinite(values).any():
            place = int((np.nanargmax if name.startswith('cond') else np.nanargmin)(values))
            extremes[_extreme(name)] = float(values[place])
            extremes[f'theta_deg_of_it_{name}'] = float(np.degrees(linkage.thetas[place]))
    return extremes


def _extreme(name: str) -> str:
    return f'{"largest" if name.startswith("cond") else "smallest"}_{name}'


def _table(spans: Mapping[str, list[float]], linkages: list[LinkageConditioning]) -> str:
    lines = [f'{"l_a / l_b":<34}' + ''.join(f'{ratio:>9g}' for ratio in OF_RATIO)]
    for title, with_length in (('cond A', False), ('mass with length, cond A', True)):
        lines.append(f'{title:<34}' + ''.join(
            f'{condition(parallelogram(ratio, with_length), SQUARE):>9.4f}' for ratio in OF_RATIO))
    lines += ['', f'{f"offset up to which cond A <= {STABLE:g}":<34}' + ''.join(
        f'{f"{theta:.0f} deg":>9}' for theta in np.degrees(SPAN_THETAS))]
    for name, values in spans.items():
        lines.append(f'{TITLES[name]:<34}' + ''.join(
            f'{f"{1e3 * value:.1f} mm" if np.isfinite(value) else "all":>9}' for value in values))
    for linkage in linkages:
        lines += ['', f'{linkage.title + ": extremes":<34}' + ''.join(
            f'{branch:>24}' for branch in linkage.branches)]
        extremes = [_extremes(linkage, branch) for branch in linkage.branches]
        for name in columns(next(iter(linkage.branches.values()))):
            lines.append(f'{_extreme(name).replace("_", " "):<34}' + ''.join(
                f'{_cell(each, name):>24}' for each in extremes))
    return '\n'.join([*lines, ''])


def _cell(extremes: Mapping[str, Any], name: str) -> str:
    if _extreme(name) not in extremes:
        return 'does not close'
    return f'{extremes[_extreme(name)]:.4g} at {extremes[f"theta_deg_of_it_{name}"]:.1f} deg'


def _grid_csv(name: str, values: Array, conditioning: Conditioning) -> str:
    """Return a matrix: one row for each value, one column for each theta."""
    lines = [f'{name} \\ theta_deg,' + ','.join(f'{theta:g}' for theta in np.degrees(THETAS))]
    lines += [f'{value:.9g},' + ','.join(f'{number:.7g}' for number in row)
              for value, row in zip(values, conditioning.condition)]
    return '\n'.join([*lines, ''])


def _linkages_csv(linkages: list[LinkageConditioning]) -> str:
    """Return the curves of the figure; fields are empty where the loop cannot close."""
    lines = ['linkage,branch,theta_deg,' + ','.join(
        columns(next(iter(linkages[0].branches.values()))))]
    for linkage in linkages:
        for branch, conditioning in linkage.branches.items():
            table = np.column_stack([values[0] for values in columns(conditioning).values()])
            lines += [f'{linkage.title},{branch},{theta:.6g},' + ','.join(
                f'{number:.7f}' if np.isfinite(number) else '' for number in row)
                for theta, row in zip(np.degrees(linkage.thetas), table)]
    return '\n'.join([*lines, ''])
