# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The search of paper section 4, Fig. 5, compared with the closed form.

CMA-ES over wheel motions and wheel inertias for the least eq. 9 and tracking error: several
weights of the error, several seeds, free total inertia, and the inertias of the paper. The results
are compared with the closed form and with the lower bound of eq. 9 at the same tracking error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
from dataclasses import asdict, replace
from functools import partial
import json
from math import inf, sqrt
from pathlib import Path
from typing import Any

from fourbar_ros.common.checks import at_least, at_most, Check, within
from fourbar_ros.common.output_files import OutputError, write_files
from fourbar_ros.common.progress import Progress, show_note
from fourbar_ros.mechanism import assemble, load_mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.state import make_state
from fourbar_ros.studies import figures, Result, Sample, StudyError
from fourbar_ros.studies.campaigns.workers import map_ordered
from fourbar_ros.studies.energy import turn
from fourbar_ros.studies.inertia_search import (
    Candidate,
    decode,
    DURATION,
    PAPER,
    POLYNOMIALS,
    run_search,
    Search,
    SearchResult,
    SOFT_STEP,
    TURN,
)
from fourbar_ros.studies.planned_cost import simulate_torques
import numpy as np
from scipy.integrate import trapezoid

# Weights of the tracking error along the front, and the weight of the searches that differ in
# their seed.
WEIGHTS = (0.1, 0.03, 0.01, 0.003, 1e-3, 3e-4, 1e-4, 3e-5)
USUAL_WEIGHT, SEEDS = 0.01, 10
# Weights of the total inertia where it is free.
INERTIA_WEIGHTS = (0.25, 1.0, 4.0)

# Largest error of a search that is compared with the closed form [deg], and relative tolerance.
LARGEST_ERROR, NEAR = 0.1, 0.01
# Largest error up to which every search must reach the lower bound [deg]. Beyond it the bound
# starts with a jerk, which polynomials that start at rest cannot follow.
LARGEST_COMPARED = 1.0
ROUNDING = 1e-6
INTEGRATED_RAD, STEPS = 1e-6, 2000
VERSION = 1
"""Version of the stored searches; those of another version are repeated."""


def searches(seed: int) -> list[tuple[str, Search]]:
    """List all searches with their kinds; search number k has the seed `seed + k`."""
    listed = [*(('front', Search(weight, 0)) for weight in WEIGHTS),
              *(('seeds', Search(USUAL_WEIGHT, 0)) for _ in range(SEEDS)),
              *(('total', Search(USUAL_WEIGHT, 0, weight)) for weight in INERTIA_WEIGHTS),
              ('paper', Search(USUAL_WEIGHT, 0, inertias=PAPER))]
    return [(kind, replace(search, seed=seed + number))
            for number, (kind, search) in enumerate(listed)]


def run(progress: Progress, sample: Sample, folder: Path | None) -> Result:
    """
    Run all searches, and compare them with the closed form.

    :param folder: where each finished search is stored; None: nowhere.
    :raises StudyError: a search cannot be stored.
    """
    listed, results = searches(sample.seed), []
    search_or_resume = partial(_resume, folder=folder)
    with contextlib.closing(map_ordered(
            search_or_resume, [search for _, search in listed], sample.jobs)) as done:
        shown = progress(done, len(listed))
        for (kind, search), (variables, evaluations) in zip(listed, shown):
            results.append(SearchResult(kind, search, decode(np.array(variables)), evaluations))
            best = best_of(results)
            show_note(shown, f'best {best.ratio:.5f} of the closed form at {best.error:.3f} deg')
    best = best_of(results)
    paper = _paper_inertias()
    files: dict[str, str | bytes] = {'inertia.csv': _csv(results)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.inertia_figure import png
        files['inertia.png'] = png(results, best)
    data = {'seed': sample.seed, 'best': best.as_json(), 'paper_inertias': paper,
            'searches': [result.as_json() for result in results]}
    return Result(_checks(results, best), data, _table(results, best, paper), files, skipped)


def best_of(results: Sequence[SearchResult]) -> SearchResult:
    """Return the result with the least eq. 9 within `LARGEST_ERROR`, else the most accurate."""
    near = [result for result in results
            if result.error <= LARGEST_ERROR and result.kind in ('front', 'seeds')]
    return min(near, key=lambda result: result.ratio) if near else min(
        results, key=lambda result: result.error)


def integration_error(candidate: Candidate) -> float:
    """
    Integrate the paper's linkage with the wheel motions of a candidate.

    :returns: difference of the tracking errors of integrator and search, rms [rad].
    """
    nominal = load_mechanism('paper')
    inertias = nominal.flywheel_inertias * candidate.inertias
    # Inertia of a pair, without its wheels, whose speeds are absolute.
    pair = float(2.0 * nominal.link_inertias[0]
                 + 0.5 * nominal.link_masses[0] * nominal.link_lengths[0] ** 2)
    unit = TURN / DURATION * pair / (2.0 * float(nominal.flywheel_inertias[0]))
    shares = np.linspace(0.0, 1.0, 2 * STEPS + 1)
    slopes = np.array([speed.deriv()(shares) for speed in POLYNOMIALS])
    torques = -inertias * unit / DURATION * (candidate.coefficients @ slopes).T
    angles = simulate_torques(nominal, make_state(assemble(nominal, 0.0, np.pi / 3.0)), torques,
                              DURATION / STEPS)
    errors = angles - angles[0] - TURN * SOFT_STEP(shares[::2])[:, None]
    squared = float(trapezoid((errors ** 2).mean(axis=1))) / STEPS
    return abs(sqrt(squared) - candidate.error_rms)


def _resume(search: Search, folder: Path | None) -> tuple[list[float], int]:
    """Return a stored search, or run it and store it."""
    described = json.loads(json.dumps({'version': VERSION, **asdict(search)}))
    path = None if folder is None else folder / 'searches' / f'seed_{search.seed}.json'
    if path is not None:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            stored = json.loads(path.read_text())
            if stored['search'] == described:
                return stored['variables'], stored['evaluations']
    best, evaluations = run_search(search)
    variables = best.tolist()
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_files({path: json.dumps({
                'search': described, 'variables': variables, 'evaluations': evaluations})})
        except (OSError, OutputError) as error:
            raise StudyError(f'cannot store {path}: {error}; finished searches are stored, repeat '
                             'the command to resume', path=path) from None
    return variables, evaluations


def _paper_inertias() -> dict[str, Any]:
    """Evaluate the inertias of the paper's Fig. 5 at zero tracking error."""
    nominal, inertias = load_mechanism('paper'), np.array(PAPER)
    ac, bd = inertias[0] + inertias[2], inertias[1] + inertias[3]

    def eq9(relative: Array, law: str) -> float:
        mechanism = replace(nominal, flywheel_inertias=nominal.flywheel_inertias * relative)
        return float(turn(mechanism, (TURN, TURN), law).eq9[-1])

    same = eq9(np.ones(4), 'min_norm')
    return {'inertias_over_nominal': PAPER,
            'total_inertia_over_nominal': float(inertias.sum()) / 4.0,
            'eq9_least_over_four_nominal': float(1.0 / ac + 1.0 / bd),
            'eq9_eq8_over_four_nominal': eq9(inertias, 'min_norm') / same,
            'eq9_min_energy_over_four_nominal': eq9(inertias, 'min_energy') / same,
            'eq9_least_over_closed_form_of_same_total': float(
                (1.0 / ac + 1.0 / bd) * inertias.sum() / 4.0)}


def _checks(results: Sequence[SearchResult], best: SearchResult) -> list[Check]:
    free = [result for result in results
            if result.kind != 'paper' and result.error <= LARGEST_COMPARED]
    return [
        within(f'best search up to {LARGEST_ERROR:g} deg: eq. 9 over the closed form', best.ratio,
               '', 1.0 - NEAR, 1.0 + NEAR),
        at_most('its tracking error, rms', best.error, 'deg', LARGEST_ERROR),
        at_most('it flown: tracking error beside what was searched with',
                integration_error(best.candidate), 'rad', INTEGRATED_RAD),
        at_least('all searches: eq. 9 over the least at their error, smallest',
                 min(result.over_bound for result in results), '', 1.0 - ROUNDING),
        at_most(f'all searches of inertias up to {LARGEST_COMPARED:g} deg: the same, largest',
                max((result.over_bound for result in free), default=inf), '', 1.0 + NEAR),
        at_least('all searches made to follow exactly: eq. 9 over the closed form, smallest',
                 min(result.ratio_without_error for result in results), '', 1.0 - ROUNDING)]


def _table(results: Sequence[SearchResult], best: SearchResult, paper: Mapping[str, Any]) -> str:
    lines = [f'{"":<8}{"weight":>8}{"error":>10}{"eq. 9":>10}{"over":>10}{"total":>8}'
             '   inertias a, b, c, d',
             f'{"":<8}{"":>8}{"deg":>10}{"(closed)":>10}{"bound":>10}{"":>8}   of nominal']
    lines += [
        f'{result.kind:<8}{result.search.error_weight:>8g}{result.error:>10.4f}'
        f'{result.ratio:>10.5f}{result.over_bound:>10.5f}{result.candidate.total:>8.3f}   '
        + ' '.join(f'{inertia:.3f}' for inertia in result.candidate.inertias)
        for result in results]
    lines += ['', f'best up to {LARGEST_ERROR:g} deg: eq. 9 is {best.ratio:.5f} of the closed '
                  f'form at {best.error:.4f} deg',
              'inertias of the paper: eq. 9 of four nominal wheels times '
              f'{paper["eq9_least_over_four_nominal"]:.4f} at best, '
              f'{paper["eq9_eq8_over_four_nominal"]:.4f} by eq. 8; of wheels of the same total '
              f'times {paper["eq9_least_over_closed_form_of_same_total"]:.4f}']
    return '\n'.join(lines)


def _csv(results: Sequence[SearchResult]) -> str:
    lines = ['kind,error_weight,inertia_weight,seed,error_rms_deg,eq9_over_closed_form,'
             'eq9_over_least_at_error,total_inertia_over_nominal,'
             + ','.join(f'inertia_{letter}_over_nominal' for letter in 'abcd')]
    for result in results:
        weight = result.search.inertia_weight
        values = (result.error, result.ratio, result.over_bound, result.candidate.total,
                  *result.candidate.inertias)
        lines.append(f'{result.kind},{result.search.error_weight:g},'
                     f'{"" if weight is None else weight},{result.search.seed},'
                     + ','.join(f'{value:.9g}' for value in values))
    return '\n'.join([*lines, ''])
