# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Inertias and mass centres of the links, as far as a motion tells them.

Simulated link angles are fitted to the measured ones by weighted least squares (output error),
which is unbiased under white noise of the sensors. Losses, errors of the sensors' zeros and the
initial state of every window are fitted along and not kept. Which combinations of the parameters
the data determine is told by the eigenvectors of the information about them, measured in units of
what is believed beforehand; the others stay where the mechanism file has them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.link_model import (
    LOSSES,
    Losses,
    parameters_of,
    simulate,
    Variant,
    Window,
    windows_of,
    with_parameters,
)
from fourbar_ros.analysis.calibration.quantity import (
    CalibrationError,
    correlation_factor,
    Quantity,
)
from fourbar_ros.analysis.calibration.signals import LinkSignal, WheelSignal
from fourbar_ros.mechanism import LINK_NAMES, Mechanism, reduced_form
import numpy as np

# How far a mechanism file may be off beforehand: share of an inertia, and of half a link's length.
PRIOR = 0.1
# Told by the data is what they tell ten times as well: to a hundredth of the value.
DETERMINED = 100.0
# Zeros of the sensors, after these were calibrated [rad].
ZERO_SIGMA = 2e-3
# Initial states as curves through the measured angles have them: two angles, two rates.
START_SIGMAS = np.array([3e-3, 3e-3, 0.05, 0.05])
MOST_ROUNDS = 40
# A round that moves no combination by more of its standard error is the last.
CONVERGED = 0.05
# So is one that gains nothing and would move none by more: dry friction is not smooth.
ROUGH = 1.0
# Of the sizes of parameters, for derivatives.
NUDGE = 1e-3

PARAMETERS = (*(f'inertia {name}' for name in LINK_NAMES),
              *(f'com {axis} {name}' for name in LINK_NAMES for axis in 'xy'))
UNITS = ('kg m^2',) * 4 + ('m',) * 8
_COUNT = len(PARAMETERS)
_NUISANCES = len(LOSSES) + 4


@dataclass(frozen=True, eq=False)
class Combination:
    """
    A direction in the space of the parameters, and how well the data know it.

    :param weights: (12,) of the parameters over their prior standard deviations; of unit length.
    :param error: standard error of the combination, in these deviations.
    :param change: found minus believed beforehand, likewise; 0 where the data do not tell it.
    :param determined: whether they do.
    """

    weights: Floats
    error: float
    change: float
    determined: bool

    @property
    def text(self) -> str:
        """Name the parameters that count in it."""
        order = np.argsort(-np.abs(self.weights))
        terms = [(float(self.weights[n]), PARAMETERS[n]) for n in order
                 if abs(self.weights[n]) > 0.15 * np.abs(self.weights).max()]
        sign = np.sign(terms[0][0])
        return ' '.join(f'{"+" if sign * weight > 0 else "-"}{abs(weight):.2f} {name}'
                        for weight, name in terms)


@dataclass(frozen=True, eq=False)
class LinkEstimate:
    """
    What was found of the links.

    :param before: the mechanism that was believed.
    :param mechanism: the same, moved as far as the data tell.
    :param sizes: (12,) prior standard deviations of the parameters.
    :param covariance: (12, 12) of the parameters over these, the prior included.
    :param combinations: all twelve, the best known first.
    :param losses: fitted along.
    :param noise: rms of the residuals [rad].
    :param poses: (k, 4) link angles from one end of the motion to the other [rad].
    :param residuals: for each link the instants [s], the measured angles and what is left [rad].
    """

    before: Mechanism
    mechanism: Mechanism
    sizes: Floats
    covariance: Floats
    combinations: tuple[Combination, ...]
    losses: Losses
    noise: float
    poses: Floats
    residuals: tuple[tuple[Floats, Floats, Floats], ...]

    @property
    def excess(self) -> float:
        """
        How many times the residuals are what changes from sample to sample [1].

        About 1 where nothing but noise is left; more where something moved the links that is not
        in the model.
        """
        steps = np.concatenate([np.diff(left) for _, _, left in self.residuals])
        left = np.concatenate([left for _, _, left in self.residuals])
        return float(np.sqrt(2.0 * np.mean(left ** 2) / np.mean(steps ** 2)))

    def parameters(self) -> list[Quantity]:
        """Return the twelve, whose intervals rest on the prior where the data do not tell."""
        errors = self.sizes * np.sqrt(np.diag(self.covariance))
        return [Quantity(name, unit, float(value), float(error), float(before))
                for name, unit, value, error, before in zip(
                    PARAMETERS, UNITS, parameters_of(self.mechanism), errors,
                    parameters_of(self.before))]

    def reduced_inertias(self) -> list[Quantity]:
        """
        Return the mass matrix A of the reduced form (docs/mechanics.md) at the poses.

        This is what any motion depends on, and does not ask which parameters make it up.
        """
        values, before = (_reduced(mechanism, self.poses)
                          for mechanism in (self.mechanism, self.before))
        base = parameters_of(self.mechanism)
        slopes = np.array([
            (_reduced(with_parameters(self.mechanism, base + step), self.poses) - values) / NUDGE
            for step in np.diag(NUDGE * self.sizes)])
        errors = np.sqrt(np.einsum('i...,ij,j...->...', slopes, self.covariance, slopes))
        return [
            Quantity(f'A_{entry} at {np.degrees(pose[1] - pose[0]):.0f} deg', 'kg m^2',
                     float(values[row, column]), float(errors[row, column]),
                     float(before[row, column]))
            for row, pose in enumerate(self.poses)
            for column, entry in enumerate(('aa', 'ab', 'bb'))]


def _reduced(mechanism: Mechanism, poses: Floats) -> Floats:
    """Return A_aa, A_ab, A_bb at every pose, (k, 3) [kg m^2]."""
    return np.array([reduced_form(mechanism, pose, np.zeros(4)).mass_matrix[[0, 0, 1], [0, 1, 1]]
                     for pose in poses])


@dataclass(frozen=True, eq=False)
class _Guess:
    """Everything that is fitted: parameters and nuisances in their sizes, initial states."""

    scaled: Floats
    starts: Floats


def link_estimate(mechanism: Mechanism, links: LinkSignal, wheels: WheelSignal,
                  ) -> LinkEstimate:
    """
    Estimate inertias and mass centres.

    :param mechanism: what is believed; lengths, masses and the wheels' inertias are kept.
    :raises CalibrationError: the recording is too short or has gaps, the links did not move, or
        no fit was found.
    """
    mechanism = mechanism.with_rigid_joints()
    return _Fit(mechanism, windows_of(links, wheels)).run()


class _Fit:
    """The least-squares problem of one recording."""

    def __init__(self, mechanism: Mechanism, windows: Sequence[Window]) -> None:
        self._mechanism = mechanism
        self._windows = windows
        swing = max(float(np.ptp(angles)) for window in windows
                    for _, angles in window.samples)
        if swing < 0.02:
            raise CalibrationError(
                f'the links turned by {swing:.2g} rad, and 0.02 rad are needed at least: drive '
                'them harder')
        self._begin = np.array([window.start for window in windows])
        half = 0.5 * mechanism.link_lengths
        self.sizes = PRIOR * np.concatenate([mechanism.link_inertias, np.repeat(half, 2)])
        # Losses that would take what a typical torque gives are the scale of losses.
        inertia = float(np.mean(mechanism.link_inertias + mechanism.link_masses * half ** 2))
        mass = float(mechanism.link_masses.mean())
        self._loss_sizes = np.array([0.1, 0.05, 0.1, 0.1, 0.1]) * inertia
        self._loss_sizes[3] = 0.1 * mass
        self._all_sizes = np.concatenate([
            self.sizes, self._loss_sizes, np.full(4, ZERO_SIGMA)])

    def run(self) -> LinkEstimate:
        """Iterate Gauss-Newton steps along what is determined."""
        guess = _Guess(np.zeros(_COUNT + _NUISANCES), self._begin)
        share = 1.0
        base, columns, local = self._linearised(guess)
        for _ in range(MOST_ROUNDS):
            variance = self._variance(base)
            step, starts, values, vectors = self._step(guess, base, columns, local, variance)
            known = values > DETERMINED
            moved = float(np.abs(np.sqrt(values[known]) * (
                vectors[:, known].T @ step[:_COUNT])).max(initial=0.0))
            if known.any() and moved < CONVERGED:
                break
            after = _Guess(guess.scaled + share * step, guess.starts + share * starts)
            linear = self._linearised(after)
            if self._cost(after, linear[0], variance) < self._cost(guess, base, variance):
                guess, (base, columns, local) = after, linear
                share = min(1.0, 2.0 * share)
            elif known.any() and moved < ROUGH:
                break
            else:
                share /= 4.0
        else:
            raise CalibrationError(
                f'no fit was found in {MOST_ROUNDS} rounds: do the mechanism file and the '
                'recording belong together?')
        if not known.any():
            raise CalibrationError('the recording determines nothing of the links')
        return self._estimate(guess, base, columns, local)

    def _cost(self, guess: _Guess, base: Sequence[Floats], variance: float) -> float:
        """Return the sum of squares, that of the prior included."""
        astray = (guess.starts - self._begin) / START_SIGMAS
        return float(sum(residuals @ residuals for residuals in base) / variance
                     + guess.scaled @ guess.scaled + np.sum(astray * astray))

    def _variant(self, scaled: Floats, starts: Floats) -> Variant:
        values = parameters_of(self._mechanism) + self.sizes * scaled[:_COUNT]
        losses = self._loss_sizes * scaled[_COUNT:_COUNT + len(LOSSES)]
        return Variant(with_parameters(self._mechanism, values),
                       Losses(**dict(zip(LOSSES, losses.tolist()))), starts)

    def _residuals(self, guess: _Guess, simulated: Sequence[Sequence[Floats]]) -> list[Floats]:
        """Return measured minus simulated for each window, links one after the other."""
        zeros = ZERO_SIGMA * guess.scaled[-4:]
        return [np.concatenate([
            angles - there - zero
            for (_, angles), there, zero in zip(window.samples, tracks, zeros)])
            for window, tracks in zip(self._windows, simulated)]

    def _linearised(self, guess: _Guess) -> tuple[list[Floats], list[Floats], list[Floats]]:
        """Return residuals, and derivatives of the simulated angles, for each window."""
        physical = _COUNT + len(LOSSES)
        variants = [self._variant(guess.scaled, guess.starts)]
        for column in range(physical):
            nudged = guess.scaled.copy()
            nudged[column] += NUDGE
            variants.append(self._variant(nudged, guess.starts))
        for column in range(4):
            starts = guess.starts.copy()
            starts[:, column] += NUDGE
            variants.append(self._variant(guess.scaled, starts))
        tracks = simulate(self._windows, variants)
        flat = [[np.concatenate(window) for window in track] for track in tracks]
        columns, local = [], []
        for n, window in enumerate(self._windows):
            slopes = [(flat[1 + column][n] - flat[0][n]) / NUDGE
                      for column in range(physical + 4)]
            owner = np.repeat(np.arange(4), [len(times) for times, _ in window.samples])
            zeros = ZERO_SIGMA * (owner[:, None] == np.arange(4))
            columns.append(np.column_stack([*slopes[:physical], zeros]))
            local.append(np.column_stack(slopes[physical:]))
        return self._residuals(guess, tracks[0]), columns, local

    def _variance(self, base: Sequence[Floats]) -> float:
        """Return the variance of the residuals [rad^2]."""
        count = sum(map(len, base))
        power = sum(float(residuals @ residuals) for residuals in base)
        return power / max(1, count - 4 * len(base) - _COUNT - _NUISANCES)

    def _split(self, base: Sequence[Floats]) -> list[list[Floats]]:
        """Return by window and link what comes one after the other."""
        return [np.split(residuals, np.cumsum([len(times) for times, _ in window.samples])[:-1])
                for window, residuals in zip(self._windows, base)]

    def _step(self, guess: _Guess, base: Sequence[Floats], columns: Sequence[Floats],
              local: Sequence[Floats], variance: float
              ) -> tuple[Floats, Floats, Floats, Floats]:
        """
        Solve the linear problem, initial states eliminated, then nuisances.

        :returns: the step of parameters and nuisances, of initial states, and the eigenvalues and
            vectors of the information about the parameters.
        """
        size = _COUNT + _NUISANCES
        information, gradient, solvers = np.zeros((size, size)), np.zeros(size), []
        prior = np.sqrt(variance) / START_SIGMAS
        base = [np.concatenate([residuals, prior * astray])
                for residuals, astray in zip(base, self._begin - guess.starts)]
        columns = [np.vstack([slopes, np.zeros((4, size))]) for slopes in columns]
        for residuals, slopes, own in zip(base, columns, local):
            q, r = np.linalg.qr(np.vstack([own, np.diag(prior)]))
            rest = slopes - q @ (q.T @ slopes)
            information += rest.T @ rest / variance
            gradient += rest.T @ residuals / variance
            solvers.append((q, r))
        information += np.eye(size)     # the prior, in units of the sizes
        step = np.asarray(np.linalg.solve(information, gradient - guess.scaled), dtype=np.float64)
        # What the data alone tell of the parameters, nuisances eliminated.
        nuisance = slice(_COUNT, size)
        about = information[:_COUNT, :_COUNT] - np.eye(_COUNT) - (
            information[:_COUNT, nuisance] @ np.linalg.solve(
                information[nuisance, nuisance], information[nuisance, :_COUNT]))
        values, vectors = np.linalg.eigh(about)
        starts = np.array([
            np.linalg.solve(r, q.T @ (residuals - slopes @ step))
            for (q, r), residuals, slopes in zip(solvers, base, columns)])
        return (step, starts, np.array(np.maximum(values, 0.0), dtype=np.float64),
                np.array(vectors, dtype=np.float64))

    def _estimate(self, guess: _Guess, base: Sequence[Floats], columns: Sequence[Floats],
                  local: Sequence[Floats]) -> LinkEstimate:
        variance = self._variance(base)
        parts = self._split(base)
        # What the model misses stays for many samples, and counts for more than noise.
        stays = correlation_factor([part for window in parts for part in window])
        _, _, values, vectors = self._step(guess, base, columns, local, variance * stays)
        variances = 1.0 / (1.0 + values)
        final = self._variant(guess.scaled, guess.starts)
        combinations = [
            Combination(vectors[:, n], float(np.sqrt(variances[n])),
                        float(vectors[:, n] @ guess.scaled[:_COUNT]),
                        bool(values[n] > DETERMINED))
            for n in np.argsort(-values)]
        return LinkEstimate(
            self._mechanism, final.mechanism, self.sizes,
            vectors @ np.diag(variances) @ vectors.T, tuple(combinations), final.losses,
            float(np.sqrt(variance)), self._poses(), self._by_link(parts))

    def _poses(self) -> Floats:
        """Return the poses with the least, a middle and the largest angle between a and b."""
        near = np.array([window.near for window in self._windows])
        order = np.argsort(near[:, 1] - near[:, 0])
        return near[order[[0, len(order) // 2, -1]]]

    def _by_link(self, parts: Sequence[Sequence[Floats]]
                 ) -> tuple[tuple[Floats, Floats, Floats], ...]:
        return tuple(
            (np.concatenate([window.samples[link][0] for window in self._windows]),
             np.concatenate([window.samples[link][1] for window in self._windows]),
             np.concatenate([part[link] for part in parts])) for link in range(4))
