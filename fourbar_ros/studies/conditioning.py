# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Paper section 5, Fig. 6: cond(A) over lengths and offsets, and what it hides.

The condition number of the 2x2 mass matrix of eq. 6 over configurations: of parallelograms, by
the ratio of their lengths, and of rhombi whose mass centres are off their links. Beside it how
near a change point is, and what wheels can do: of both cond(A) says nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import io
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

from fourbar_ros.common.checks import at_most, Check, finite_or_none, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.mechanism import load_mechanism, Mechanism, reduced_form
from fourbar_ros.mechanism.closure import BRANCHES
from fourbar_ros.mechanism.conditioning import Conditioning, conditioning_grid, WHEELS
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies import figures, Result
import numpy as np
from scipy.optimize import brentq

LENGTH = 0.1    # of link b, and of all where lengths are equal [m]
MASS, INERTIA, WHEEL_INERTIA = 0.02, 2.2e-5, 3.4e-7

POINTS = 200
# Symmetric about 90 deg, and not at a change point.
THETAS = np.pi * (np.arange(POINTS) + 0.5) / POINTS
RATIOS = np.geomspace(0.25, 4.0, POINTS)
OFFSETS = np.linspace(-0.05, 0.05, POINTS)
GRID_LIMIT = 1.0    # s

SIGNS: dict[str, tuple[float, ...]] = {
    'same': (1.0, 1.0, 1.0, 1.0), 'inside': (1.0, -1.0, -1.0, 1.0)}
TITLES = {'same': 'the same in every body frame', 'inside': 'towards the inside'}
ALL_SIGNS = tuple((1.0, *others) for others in product((1.0, -1.0), repeat=3))

# Known values of cond(A), by another model, to the digits that are given.
OF_RATIO = {0.25: 2.8657, 0.5: 2.0870, 1.0: 1.0, 2.0: 3.0833, 4.0: 11.4167}
SMALL, SQUARE = 0.3, np.pi / 2.0
OF_OFFSET = {('same', 0.02): (1.1059, 1.0), ('same', 0.04): (1.4204, 1.0),
             ('inside', 0.02): (1.3468, 3.0), ('inside', 0.04): (1.5884, 7.6667)}
"""At theta of 0.3 rad, and at 90 deg."""
DIGITS, EXACT = 5e-5, 1e-9
DIAGONAL = 1.44e-4

# Up to here cond(A) is called stable, where the spans of offsets are compared.
STABLE = 1.5
SPAN_THETAS = np.radians([10.0, 20.0, 30.0, 60.0, 90.0])
SOUGHT = np.linspace(0.0, 0.1, 101)
"""Offsets among which its end is looked for, up to a whole link [m]."""

# Near a change point: equal links, and one that is longer by this.
MISMATCH = 0.01
NEAR = np.radians(np.linspace(-40.0, 40.0, 801)[1::2])
AROUND = np.radians(np.linspace(-180.0, 180.0, 1441)[1::2])


@dataclass(frozen=True, eq=False)
class Look:
    """
    A linkage over its configurations.

    :param title: for people.
    :param thetas: (n,) [rad].
    :param branches: what was found, by branch.
    """

    title: str
    thetas: Array
    branches: Mapping[str, Conditioning]


def run(progress: Progress, mechanism: str | None = None) -> Result:
    """
    Evaluate the grids of Fig. 6, and what they hide.

    :param mechanism: preset or file of a linkage to look at as well.
    :raises FourbarError: there is no such mechanism, or it cannot exist.
    """
    given = None if mechanism is None else load_mechanism(mechanism)
    # The first call compiles.
    conditioning_grid([parallelogram(1.0)], THETAS)
    begin = perf_counter()
    ratios = conditioning_grid([parallelogram(ratio) for ratio in RATIOS], THETAS)
    seconds = perf_counter() - begin
    grids = {'ratio': ratios}
    for signs in progress(SIGNS, len(SIGNS)):
        grids[signs] = conditioning_grid(
            [rhombus(SIGNS[signs], offset) for offset in OFFSETS], THETAS)
    hidden = [_look('equal links', parallelogram(1.0), NEAR, ('open',)),
              _look(f'link a longer by {100.0 * MISMATCH:g} %', _mismatched(), NEAR, ('open',))]
    files: dict[str, str | bytes] = {
        'conditioning_ratio.csv': _grid_csv('ratio', RATIOS, grids['ratio']),
        **{f'conditioning_offset_{name}.csv': _grid_csv('offset_m', OFFSETS, grids[name])
           for name in SIGNS},
        'conditioning_hidden.csv': _looks_csv(hidden)}
    looks = []
    if given is not None:
        looks.append(_look(Path(str(mechanism)).stem, given, AROUND, BRANCHES))
        files['conditioning_linkage.csv'] = _looks_csv(looks)
    spans = {name: [span(SIGNS[name], theta) for theta in SPAN_THETAS] for name in SIGNS}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.conditioning_figure import looks_png, png
        files['conditioning.png'] = png(grids)
        files['conditioning_hidden.png'] = looks_png(hidden)
        if looks:
            files['conditioning_linkage.png'] = looks_png(looks)
    return Result(_checks(grids, seconds), _data(spans, seconds, looks), _table(spans, looks),
                  files, skipped)


def parallelogram(ratio: float, with_length: bool = False) -> Mechanism:
    """
    Make a parallelogram of uniform links, l_b of 0.1 m, by its l_a / l_b.

    :param with_length: links a and c have mass and inertia of their length, instead of those of
        the others, as the paper has it.
    """
    scale = np.array([ratio, 1.0, ratio, 1.0])
    heavier = scale if with_length else np.ones(4)
    lengths = LENGTH * scale
    return Mechanism(
        lengths, MASS * heavier, INERTIA * heavier ** 3,
        np.column_stack([0.5 * lengths, np.zeros(4)]), np.full(4, WHEEL_INERTIA))


def rhombus(signs: tuple[float, ...], offset: float) -> Mechanism:
    """Make a rhombus of the paper's links with mass centres off the line of their joints [m]."""
    return Mechanism(
        np.full(4, LENGTH), np.full(4, MASS), np.full(4, INERTIA),
        np.column_stack([np.full(4, 0.5 * LENGTH), offset * np.array(signs)]),
        np.full(4, WHEEL_INERTIA))


def span(signs: tuple[float, ...], theta: float) -> float:
    """Return up to which offset cond(A) is at most `STABLE` [m], inf if up to a whole link."""
    def excess(offset: float) -> float:
        return condition(rhombus(signs, offset), theta) - STABLE
    found = conditioning_grid([rhombus(signs, offset) for offset in SOUGHT], [theta]).condition
    # The first end: offsets towards the inside have a worst one, beyond which it is better again.
    if (found <= STABLE).all():
        return np.inf
    first = int(np.argmax(found > STABLE))
    return float(brentq(excess, SOUGHT[first - 1], SOUGHT[first], xtol=1e-9))


def condition(mechanism: Mechanism, theta: float) -> float:
    """Return cond(A) of a linkage in one configuration [rad], on the open branch."""
    return float(conditioning_grid([mechanism], [theta]).condition[0, 0])


def _mismatched() -> Mechanism:
    lengths = LENGTH * np.array([1.0 + MISMATCH, 1.0, 1.0, 1.0])
    return Mechanism(
        lengths, np.full(4, MASS), np.full(4, INERTIA),
        np.column_stack([0.5 * lengths, np.zeros(4)]), np.full(4, WHEEL_INERTIA))


def _look(title: str, mechanism: Mechanism, thetas: Array, branches: tuple[str, ...]) -> Look:
    return Look(title, thetas, {
        branch: conditioning_grid([mechanism], thetas, branch) for branch in branches})


def worst_of_three(found: Conditioning) -> Array:
    """Return what three wheels can do after the loss of the one that hurts most (m, n)."""
    worst: Array = found.gains[..., 1:5].min(axis=-1)
    return worst


def columns(found: Conditioning) -> dict[str, Array]:
    """Return what is written of linkages, (m, n) by name of the column."""
    pairs = {f'gain_wheels_{"".join(letter for letter, left in zip("abcd", row) if left)}':
             found.gains[..., place] for place, row in enumerate(WHEELS) if place > 4}
    return {
        'cond_a': found.condition, 'cond_of_motions': found.condition_of_motions,
        'alignment': found.alignment, 'closure_ratio': found.closure_ratio,
        'gain_four_wheels': found.gains[..., 0], 'gain_three_wheels_worst': worst_of_three(found),
        **pairs}


def _checks(grids: Mapping[str, Conditioning], seconds: float) -> list[Check]:
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
        found = conditioning_grid([parallelogram(ratio)], THETAS).condition
        checks.append(within(f'cond A, l_a / l_b = {ratio:g}', float(found.mean()), '',
                             known - DIGITS, known + DIGITS))
    of_ratio = grids['ratio'].condition
    checks.append(at_most('cond A of parallelograms, change with theta, relative', float(
        (np.ptp(of_ratio, axis=1) / of_ratio.mean(axis=1)).max()), '', EXACT))
    for (name, offset), known_pair in OF_OFFSET.items():
        for theta, known in zip((SMALL, SQUARE), known_pair):
            checks.append(within(
                f'cond A, offset {1e3 * offset:g} mm {TITLES[name]}, theta = {theta:.4g} rad',
                condition(rhombus(SIGNS[name], offset), theta), '', known - DIGITS,
                known + DIGITS))
    checks += [
        at_most('all eight sign conventions: cond A, change with the sign of the offset, relative',
                asymmetry(), '', EXACT),
        at_most(f'grid of {POINTS} x {POINTS} linkages and configurations', seconds, 's',
                GRID_LIMIT)]
    return checks


def asymmetry() -> float:
    """Return how far cond(A) with an offset is from that with the opposite one, relative."""
    far = 0.0
    for signs in ALL_SIGNS:
        found = conditioning_grid(
            [rhombus(signs, offset) for offset in OFFSETS], THETAS).condition
        far = max(far, float((np.abs(found - found[::-1]) / found).max()))
    return far


def _data(spans: Mapping[str, list[float]], seconds: float, looks: list[Look]) -> dict[str, Any]:
    return {
        'grid_points': POINTS * POINTS, 'grid_seconds': seconds,
        'cond_of_ratio': {f'{ratio:g}': condition(parallelogram(ratio), SQUARE)
                          for ratio in OF_RATIO},
        'cond_of_ratio_mass_with_length': {
            f'{ratio:g}': condition(parallelogram(ratio, True), SQUARE) for ratio in OF_RATIO},
        'stable_cond': STABLE,
        'stable_offset_m': {name: {f'{theta:g}_deg': finite_or_none(value) for theta, value in zip(
            np.degrees(SPAN_THETAS).round(9), values)} for name, values in spans.items()},
        'linkages': {look.title: {branch: _extremes(look, found)
                                  for branch, found in look.branches.items()} for look in looks}}


def _extremes(look: Look, found: Conditioning) -> dict[str, Any]:
    """Return largest condition numbers and smallest of the others, and where they are."""
    closed = np.isfinite(found.closure_ratio[0])
    extremes: dict[str, Any] = {'closes_share': float(closed.mean())}
    for name, (values, *_) in columns(found).items():
        if np.isfinite(values).any():
            largest = name.startswith('cond')
            place = int(np.nanargmax(values) if largest else np.nanargmin(values))
            extremes[f'{"largest" if largest else "smallest"}_{name}'] = float(values[place])
            extremes[f'theta_deg_of_it_{name}'] = float(np.degrees(look.thetas[place]))
    return extremes


def _table(spans: Mapping[str, list[float]], looks: list[Look]) -> str:
    lines = [f'{"l_a / l_b":<34}' + ''.join(f'{ratio:>9g}' for ratio in OF_RATIO)]
    for title, with_length in (('cond A', False), ('mass with length, cond A', True)):
        lines.append(f'{title:<34}' + ''.join(
            f'{condition(parallelogram(ratio, with_length), SQUARE):>9.4f}' for ratio in OF_RATIO))
    lines += ['', f'{f"offset up to which cond A <= {STABLE:g}":<34}' + ''.join(
        f'{f"{theta:.0f} deg":>9}' for theta in np.degrees(SPAN_THETAS))]
    for name, values in spans.items():
        lines.append(f'{TITLES[name]:<34}' + ''.join(
            f'{f"{1e3 * value:.1f} mm" if np.isfinite(value) else "all":>9}' for value in values))
    for look in looks:
        lines += ['', f'{look.title + ": extremes":<34}' + ''.join(
            f'{branch:>24}' for branch in look.branches)]
        found = {branch: _extremes(look, each) for branch, each in look.branches.items()}
        for name in columns(next(iter(look.branches.values()))):
            key = f'{"largest" if name.startswith("cond") else "smallest"}_{name}'
            lines.append(f'{key.replace("_", " "):<34}' + ''.join(
                f'{_at(each, key, name):>24}' for each in found.values()))
    return '\n'.join([*lines, ''])


def _at(extremes: Mapping[str, Any], key: str, name: str) -> str:
    if key not in extremes:
        return 'does not close'
    value, theta = extremes[key], extremes[f'theta_deg_of_it_{name}']
    return f'{value:.4g} at {theta:.1f} deg'


def _grid_csv(name: str, values: Array, found: Conditioning) -> str:
    """Return a matrix: one row for each value, one column for each theta."""
    file = io.StringIO()
    file.write(f'{name} \\ theta_deg,' + ','.join(f'{theta:g}' for theta in np.degrees(THETAS))
               + '\n')
    for value, row in zip(values, found.condition):
        file.write(f'{value:.9g},' + ','.join(f'{number:.7g}' for number in row) + '\n')
    return file.getvalue()


def _looks_csv(looks: list[Look]) -> str:
    """Return what the figure shows; fields are empty where the loop cannot close."""
    file = io.StringIO()
    names = columns(next(iter(looks[0].branches.values())))
    file.write('linkage,branch,theta_deg,' + ','.join(names) + '\n')
    for look in looks:
        for branch, found in look.branches.items():
            table = np.column_stack([values[0] for values in columns(found).values()])
            for theta, row in zip(np.degrees(look.thetas), table):
                file.write(f'{look.title},{branch},{theta:.6g},' + ','.join(
                    f'{number:.7f}' if np.isfinite(number) else '' for number in row) + '\n')
    return file.getvalue()
