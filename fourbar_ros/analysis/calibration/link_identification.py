# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Inertias and mass centres of the links by the output-error method.

Gauss-Newton iterations fit simulated to measured link angles by weighted least squares with a
prior; the estimate is unbiased under white sensor noise. Losses, sensor offsets and the initial
state of each window are nuisance parameters: they are estimated and discarded. The eigenvectors
of the Fisher information matrix, in units of the prior standard deviations, show which
combinations of the parameters the data determine; the others keep the values of the mechanism
file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.measurements import LinkMeasurements, WheelMeasurements
from fourbar_ros.analysis.calibration.output_error import (
    divide,
    link_parameters,
    LOSS_NAMES,
    Losses,
    ModelParameters,
    simulate_links,
    Window,
    with_parameters,
)
from fourbar_ros.analysis.calibration.parameter_estimates import (
    CalibrationError,
    ParameterEstimate,
    variance_inflation,
)
from fourbar_ros.mechanism import LINK_NAMES, Mechanism, reduced_form
import numpy as np

# Prior standard deviation, over an inertia or half of a link length.
PRIOR = 0.1
# Least information of a determined combination, in units of the prior. The data reduce its
# standard deviation to a tenth of the prior, or 1 % of the value.
DETERMINED = 100.0
# Prior standard deviation of sensor offsets after their calibration [rad].
OFFSET_SIGMA = 2e-3
# Prior standard deviations of the initial states from splines: angles [rad], rates [rad/s].
INITIAL_SIGMAS = np.array([3e-3, 3e-3, 0.05, 0.05])
MAX_ITERATIONS = 40
# Step of the last iteration, in standard errors of the determined combinations.
CONVERGED = 0.05
# Step of the last iteration if the cost does not decrease, in standard errors. Coulomb friction is
# not smooth, which limits the accuracy of derivatives.
NOT_SMOOTH = 1.0
# Step of finite differences, in prior standard deviations.
DIFFERENCE = 1e-3
# Least turn of a link during the recording [rad].
MIN_TURN = 0.02

PARAMETERS = (*(f'inertia {name}' for name in LINK_NAMES),
              *(f'com {axis} {name}' for name in LINK_NAMES for axis in 'xy'))
UNITS = ('kg m^2',) * 4 + ('m',) * 8
_COUNT = len(PARAMETERS)
_NUISANCES = len(LOSS_NAMES) + 4


@dataclass(frozen=True, eq=False)
class Combination:
    """
    Linear combination of the parameters, an eigenvector of the information matrix.

    :param weights: (12,) of the parameters over their prior standard deviations; unit norm.
    :param error: standard error of the combination, in prior standard deviations.
    :param change: estimate minus prior value, in prior standard deviations.
    :param determined: whether the data determine it.
    """

    weights: Floats
    error: float
    change: float
    determined: bool

    @property
    def text(self) -> str:
        """The parameters with the largest weights."""
        order = np.argsort(-np.abs(self.weights))
        terms = [(float(self.weights[n]), PARAMETERS[n]) for n in order
                 if abs(self.weights[n]) > 0.15 * np.abs(self.weights).max()]
        sign = np.sign(terms[0][0])
        return ' '.join(f'{"+" if sign * weight > 0 else "-"}{abs(weight):.2f} {name}'
                        for weight, name in terms)


@dataclass(frozen=True, eq=False)
class LinkEstimate:
    """
    Estimated parameters of the links.

    :param before: mechanism before the calibration.
    :param mechanism: mechanism with the estimates.
    :param prior_sigmas: (12,) prior standard deviations of the parameters.
    :param covariance: (12, 12) posterior covariance of the parameters over these.
    :param combinations: all twelve, in order of decreasing information.
    :param losses: estimated with the parameters.
    :param noise: rms of the residuals [rad].
    :param poses: (3, 4) link angles from one end of the motion to the other [rad].
    :param residuals: for each link times [s], measured angles [rad] and residuals [rad].
    """

    before: Mechanism
    mechanism: Mechanism
    prior_sigmas: Floats
    covariance: Floats
    combinations: tuple[Combination, ...]
    losses: Losses
    noise: float
    poses: Floats
    residuals: tuple[tuple[Floats, Floats, Floats], ...]

    @property
    def residual_ratio(self) -> float:
        """
        Rms of the residuals over that of white noise with the same sample-to-sample changes [1].

        It is about 1 for white residuals, and larger if a disturbance outside the model moved the
        links (von Neumann ratio).
        """
        steps = np.concatenate([np.diff(residuals) for _, _, residuals in self.residuals])
        values = np.concatenate([residuals for _, _, residuals in self.residuals])
        return float(np.sqrt(2.0 * np.mean(values ** 2) / np.mean(steps ** 2)))

    def parameters(self) -> list[ParameterEstimate]:
        """Return the twelve parameters; without information the intervals are the prior's."""
        errors = self.prior_sigmas * np.sqrt(np.diag(self.covariance))
        return [ParameterEstimate(name, unit, float(value), float(error), float(before))
                for name, unit, value, error, before in zip(
                    PARAMETERS, UNITS, link_parameters(self.mechanism), errors,
                    link_parameters(self.before))]

    def reduced_inertias(self) -> list[ParameterEstimate]:
        """
        Return the mass matrix A of the reduced form (docs/mechanics.md) at the poses.

        Any motion depends on the parameters through this matrix only.
        """
        values, before = (_reduced(mechanism, self.poses)
                          for mechanism in (self.mechanism, self.before))
        base = link_parameters(self.mechanism)
        slopes = np.array([
            (_reduced(with_parameters(self.mechanism, base + step), self.poses) - values)
            / DIFFERENCE for step in np.diag(DIFFERENCE * self.prior_sigmas)])
        errors = np.sqrt(np.einsum('i...,ij,j...->...', slopes, self.covariance, slopes))
        return [
            ParameterEstimate(f'A_{entry} at {np.degrees(pose[1] - pose[0]):.0f} deg', 'kg m^2',
                              float(values[row, column]), float(errors[row, column]),
                              float(before[row, column]))
            for row, pose in enumerate(self.poses)
            for column, entry in enumerate(('aa', 'ab', 'bb'))]


def _reduced(mechanism: Mechanism, poses: Floats) -> Floats:
    """Return A_aa, A_ab, A_bb at every pose, (k, 3) [kg m^2]."""
    return np.array([reduced_form(mechanism, pose, np.zeros(4)).mass_matrix[[0, 0, 1], [0, 1, 1]]
                     for pose in poses])


@dataclass(frozen=True, eq=False)
class _Iterate:
    """Parameters and nuisance parameters in prior standard deviations, and initial states."""

    scaled: Floats
    initial: Floats


def link_estimate(mechanism: Mechanism, links: LinkMeasurements, wheels: WheelMeasurements
                  ) -> LinkEstimate:
    """
    Estimate inertias and mass centres.

    :param mechanism: prior values; lengths, masses and wheel inertias stay fixed.
    :raises CalibrationError: the recording is too short or has gaps, the links did not move, or
        the iterations did not converge.
    """
    mechanism = mechanism.with_rigid_joints()
    return _Fit(mechanism, divide(links, wheels)).run()


class _Fit:
    """Least-squares problem of one recording."""

    def __init__(self, mechanism: Mechanism, windows: Sequence[Window]) -> None:
        self._mechanism = mechanism
        self._windows = windows
        turn = max(float(np.ptp(angles)) for window in windows for _, angles in window.samples)
        if turn < MIN_TURN:
            raise CalibrationError(
                f'the links turned by {turn:.2g} rad, at least {MIN_TURN:g} rad are required: '
                'increase the torque', reason='excitation', value=turn, limit=MIN_TURN)
        self._prior_initial = np.array([window.initial for window in windows])
        half = 0.5 * mechanism.link_lengths
        self._prior_sigmas = PRIOR * np.concatenate([mechanism.link_inertias, np.repeat(half, 2)])
        # Losses of the order of the torques of a typical motion.
        inertia = float(np.mean(mechanism.link_inertias + mechanism.link_masses * half ** 2))
        mass = float(mechanism.link_masses.mean())
        self._loss_sigmas = np.array([0.1, 0.05, 0.1, 0.1, 0.1]) * inertia
        self._loss_sigmas[3] = 0.1 * mass

    def run(self) -> LinkEstimate:
        """Iterate damped Gauss-Newton steps until the determined combinations converge."""
        iterate = _Iterate(np.zeros(_COUNT + _NUISANCES), self._prior_initial)
        share = 1.0
        base, columns, local = self._linearise(iterate)
        for _ in range(MAX_ITERATIONS):
            variance = self._variance(base)
            step, initial, values, vectors = self._step(iterate, base, columns, local, variance)
            known = values > DETERMINED
            moved = float(np.abs(np.sqrt(values[known]) * (
                vectors[:, known].T @ step[:_COUNT])).max(initial=0.0))
            if known.any() and moved < CONVERGED:
                break
            after = _Iterate(
                iterate.scaled + share * step, iterate.initial + share * initial)
            linear = self._linearise(after)
            if self._cost(after, linear[0], variance) < self._cost(iterate, base, variance):
                iterate, (base, columns, local) = after, linear
                share = min(1.0, 2.0 * share)
            elif known.any() and moved < NOT_SMOOTH:
                break
            else:
                share /= 4.0
        else:
            raise CalibrationError(
                f'no convergence within {MAX_ITERATIONS} iterations: check that the mechanism '
                'file and the recording belong together', reason='no_convergence',
                limit=MAX_ITERATIONS)
        if not known.any():
            raise CalibrationError('the recording determines no parameter of the links',
                                   reason='not_determined')
        return self._estimate(iterate, base, columns, local)

    def _cost(self, iterate: _Iterate, base: Sequence[Floats], variance: float) -> float:
        """Return the weighted sum of squares of residuals and prior."""
        deviations = (iterate.initial - self._prior_initial) / INITIAL_SIGMAS
        return float(sum(residuals @ residuals for residuals in base) / variance
                     + iterate.scaled @ iterate.scaled + np.sum(deviations * deviations))

    def _model(self, scaled: Floats, initial: Floats) -> ModelParameters:
        values = link_parameters(self._mechanism) + self._prior_sigmas * scaled[:_COUNT]
        losses = self._loss_sigmas * scaled[_COUNT:_COUNT + len(LOSS_NAMES)]
        return ModelParameters(with_parameters(self._mechanism, values),
                               Losses(**dict(zip(LOSS_NAMES, losses.tolist()))), initial)

    def _residuals(self, iterate: _Iterate, simulated: Sequence[Sequence[Floats]]) -> list[Floats]:
        """Return measured minus simulated angles of each window, concatenated over the links."""
        offsets = OFFSET_SIGMA * iterate.scaled[-4:]
        return [np.concatenate([
            angles - model - offset
            for (_, angles), model, offset in zip(window.samples, angles_by_link, offsets)])
            for window, angles_by_link in zip(self._windows, simulated)]

    def _linearise(self, iterate: _Iterate) -> tuple[list[Floats], list[Floats], list[Floats]]:
        """Return residuals and derivatives of the simulated angles, for each window."""
        physical = _COUNT + len(LOSS_NAMES)
        variants = [self._model(iterate.scaled, iterate.initial)]
        for column in range(physical):
            shifted = iterate.scaled.copy()
            shifted[column] += DIFFERENCE
            variants.append(self._model(shifted, iterate.initial))
        for column in range(4):
            initial = iterate.initial.copy()
            initial[:, column] += DIFFERENCE
            variants.append(self._model(iterate.scaled, initial))
        simulated = simulate_links(self._windows, variants)
        flat = [[np.concatenate(window) for window in angles] for angles in simulated]
        columns, local = [], []
        for n, window in enumerate(self._windows):
            slopes = [(flat[1 + column][n] - flat[0][n]) / DIFFERENCE
                      for column in range(physical + 4)]
            owner = np.repeat(np.arange(4), [len(times) for times, _ in window.samples])
            offsets = OFFSET_SIGMA * (owner[:, None] == np.arange(4))
            columns.append(np.column_stack([*slopes[:physical], offsets]))
            local.append(np.column_stack(slopes[physical:]))
        return self._residuals(iterate, simulated[0]), columns, local

    def _variance(self, base: Sequence[Floats]) -> float:
        """Return the variance of the residuals [rad^2]."""
        count = sum(map(len, base))
        power = sum(float(residuals @ residuals) for residuals in base)
        return power / max(1, count - 4 * len(base) - _COUNT - _NUISANCES)

    def _split(self, base: Sequence[Floats]) -> list[list[Floats]]:
        """Return concatenated residuals by window and link."""
        return [np.split(residuals, np.cumsum([len(times) for times, _ in window.samples])[:-1])
                for window, residuals in zip(self._windows, base)]

    def _step(self, iterate: _Iterate, base: Sequence[Floats], columns: Sequence[Floats],
              local: Sequence[Floats], variance: float
              ) -> tuple[Floats, Floats, Floats, Floats]:
        """
        Solve the linear problem; initial states and nuisance parameters are eliminated.

        :returns: step of parameters and nuisance parameters, step of initial states, and
            eigenvalues and eigenvectors of the information matrix of the parameters.
        """
        size = _COUNT + _NUISANCES
        information, gradient, solvers = np.zeros((size, size)), np.zeros(size), []
        prior = np.sqrt(variance) / INITIAL_SIGMAS
        base = [np.concatenate([residuals, prior * deviations])
                for residuals, deviations in zip(base, self._prior_initial - iterate.initial)]
        columns = [np.vstack([slopes, np.zeros((4, size))]) for slopes in columns]
        for residuals, slopes, own in zip(base, columns, local):
            q, r = np.linalg.qr(np.vstack([own, np.diag(prior)]))
            rest = slopes - q @ (q.T @ slopes)
            information += rest.T @ rest / variance
            gradient += rest.T @ residuals / variance
            solvers.append((q, r))
        information += np.eye(size)     # the prior
        step = np.linalg.solve(information, gradient - iterate.scaled).astype(np.float64)
        # Information of the data without the prior: Schur complement of the nuisances.
        nuisance = slice(_COUNT, size)
        marginal = information[:_COUNT, :_COUNT] - np.eye(_COUNT) - (
            information[:_COUNT, nuisance] @ np.linalg.solve(
                information[nuisance, nuisance], information[nuisance, :_COUNT]))
        values, vectors = np.linalg.eigh(marginal)
        initial = np.array([
            np.linalg.solve(r, q.T @ (residuals - slopes @ step))
            for (q, r), residuals, slopes in zip(solvers, base, columns)])
        return (step, initial, np.array(np.maximum(values, 0.0), dtype=np.float64),
                np.array(vectors, dtype=np.float64))

    def _estimate(self, iterate: _Iterate, base: Sequence[Floats], columns: Sequence[Floats],
                  local: Sequence[Floats]) -> LinkEstimate:
        variance = self._variance(base)
        parts = self._split(base)
        # Model errors are correlated over many samples and widen the intervals.
        inflation = variance_inflation([part for window in parts for part in window])
        _, _, values, vectors = self._step(iterate, base, columns, local, variance * inflation)
        variances = 1.0 / (1.0 + values)
        final = self._model(iterate.scaled, iterate.initial)
        combinations = [
            Combination(vectors[:, n], float(np.sqrt(variances[n])),
                        float(vectors[:, n] @ iterate.scaled[:_COUNT]),
                        bool(values[n] > DETERMINED))
            for n in np.argsort(-values)]
        return LinkEstimate(
            self._mechanism, final.mechanism, self._prior_sigmas,
            vectors @ np.diag(variances) @ vectors.T, tuple(combinations), final.losses,
            float(np.sqrt(variance)), self._poses(), self._by_link(parts))

    def _poses(self) -> Floats:
        """Return the poses with the smallest, median and largest angle between a and b."""
        poses = np.array([window.initial_angles for window in self._windows])
        order = np.argsort(poses[:, 1] - poses[:, 0])
        return poses[order[[0, len(order) // 2, -1]]]

    def _by_link(self, parts: Sequence[Sequence[Floats]]
                 ) -> tuple[tuple[Floats, Floats, Floats], ...]:
        return tuple(
            (np.concatenate([window.samples[link][0] for window in self._windows]),
             np.concatenate([window.samples[link][1] for window in self._windows]),
             np.concatenate([part[link] for part in parts])) for link in range(4))
