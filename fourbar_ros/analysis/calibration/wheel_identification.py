# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Inertia and bearing friction of a wheel, by linear least squares on spin-ups and coast-downs.

With `p = theta + phi`, wheel angle plus link angle, the equation of motion of the wheel is
`I ddp/dt^2 = effort - coulomb sign(speed) - viscous speed`. Its double integral is linear in 1/I,
coulomb/I and viscous/I and needs no derivative of an encoder signal:

    p = p0 + h0 t + (1/I) int int effort - (coulomb/I) s t^2/2 - (viscous/I) int (theta - theta_0)

The measured link angles account for any motion of the links. Static friction decreases with the
square of the speed (`mechanism.forces.grip`); its remainder has a regressor of its own, since
a thousandth of the Coulomb friction exceeds the noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.measurements import LinkMeasurements, WheelMeasurements
from fourbar_ros.analysis.calibration.parameter_estimates import (
    CalibrationError,
    ParameterEstimate,
    variance_inflation,
)
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism
import numpy as np
from scipy.interpolate import CubicSpline

# Least speed of the fitted motion [rad/s]; static friction is relevant at a few rad/s only.
MIN_SPEED = 15.0
# Largest change of the torque within a tick, over its largest value. A larger step ends a segment,
# since the motor lag within the tick is not recorded.
MAX_TORQUE_STEP = 0.05
# Least torque of a spin-up over the largest torque.
DRIVEN_SHARE = 0.2
# Least number of samples of a segment.
MIN_SAMPLES = 25
# Least ratio of the singular values of the regressors for a unique solution.
MIN_CONDITION = 1e-6
# Parameters of the controller.
FRICTION = (('bearing_coulomb', 'N m'), ('bearing_viscous', 'N m s'))


@dataclass(frozen=True, eq=False)
class Segment:
    """
    Motion in one direction without a step of the torque.

    :param driven: whether the motor was driven (spin-up).
    :param times: (n,) of the link measurements [s].
    :param speeds: (n,) of the wheel at these times [rad/s].
    :param residuals: (n,) of wheel angle plus link angle [rad].
    """

    driven: bool
    times: Floats
    speeds: Floats
    residuals: Floats


@dataclass(frozen=True, eq=False)
class WheelEstimate:
    """
    Estimated parameters of one wheel.

    :param wheel: index.
    :param inertia: axial [kg m^2].
    :param coulomb: Coulomb friction of the bearing [N m].
    :param viscous: viscous friction of the bearing [N m s].
    :param covariance: (3, 3) of these three, in this order.
    :param segments: fitted motion.
    """

    wheel: int
    inertia: float
    coulomb: float
    viscous: float
    covariance: Floats
    segments: tuple[Segment, ...]

    def estimates(self, mechanism: Mechanism) -> list[ParameterEstimate]:
        """Return the three parameters with their intervals."""
        name, errors = FLYWHEEL_NAMES[self.wheel], np.sqrt(np.diag(self.covariance))
        before = float(mechanism.flywheel_inertias[self.wheel])
        return [
            ParameterEstimate(f'{name} inertia', 'kg m^2', self.inertia, float(errors[0]), before),
            ParameterEstimate(f'{name} coulomb', 'N m', self.coulomb, float(errors[1])),
            ParameterEstimate(f'{name} viscous', 'N m s', self.viscous, float(errors[2]))]


def driven_wheels(wheels: WheelMeasurements) -> list[int]:
    """Return the wheels that were driven and exceeded `MIN_SPEED`."""
    return [wheel for wheel in range(4)
            if np.abs(wheels.speeds[:, wheel]).max() > MIN_SPEED
            and np.abs(wheels.efforts[:, wheel]).max() > 0.0]


def wheel_estimate(wheel: int, links: LinkMeasurements, wheels: WheelMeasurements
                   ) -> WheelEstimate:
    """
    Estimate inertia and friction of one wheel.

    :param wheel: index.
    :raises CalibrationError: the recording has no spin-up or no coast-down of the wheel, or its
        motion does not determine inertia and friction separately.
    """
    name = FLYWHEEL_NAMES[wheel]
    parts = [_regression(wheel, begin, end, driven, links, wheels)
             for begin, end, driven in _segments(wheel, wheels)]
    parts = [part for part in parts if len(part.angles) >= MIN_SAMPLES]
    for driven, kind in ((True, 'spin-up'), (False, 'coast-down')):
        if not any(part.driven is driven for part in parts):
            raise CalibrationError(f'the recording has no {kind} of {name} above {MIN_SPEED:g} '
                                   f'rad/s', reason=kind, name=name, limit=MIN_SPEED)
    regressors = np.vstack([part.regressors for part in parts])
    scale = np.linalg.norm(regressors, axis=0)
    left, singular, right = np.linalg.svd(regressors / scale, full_matrices=False)
    if not singular[-1] > MIN_CONDITION * singular[0]:
        raise CalibrationError(
            f'the motion of {name} does not determine inertia and friction separately: increase '
            'the speed and the time of the coast-down', reason='not_determined', name=name)
    angles = np.concatenate([part.angles for part in parts])
    x = right.T @ (left.T @ angles / singular) / scale
    segments = tuple(Segment(part.driven, part.times, part.speeds,
                             part.angles - part.regressors @ x) for part in parts)
    degrees_of_freedom = len(angles) - len(x) - 2 * len(parts)
    variance = sum(float(segment.residuals @ segment.residuals)
                   for segment in segments) / degrees_of_freedom
    variance *= variance_inflation([segment.residuals for segment in segments])
    inverse = right.T / singular / scale[:, None]
    inertia, coulomb, viscous = (float(value / x[0]) for value in (1.0, x[1], x[2]))
    jacobian = np.array([[-inertia, 0.0, 0.0, 0.0], [-coulomb, 1.0, 0.0, 0.0],
                         [-viscous, 0.0, 1.0, 0.0]]) / x[0]
    return WheelEstimate(
        wheel, inertia, coulomb, viscous,
        variance * jacobian @ inverse @ inverse.T @ jacobian.T, segments)


@dataclass(frozen=True, eq=False)
class _Regression:
    """Equations of one segment, initial state eliminated: regressors (n, 4) x = angles (n,)."""

    driven: bool
    times: Floats
    speeds: Floats
    regressors: Floats
    angles: Floats


def _segments(wheel: int, wheels: WheelMeasurements) -> Iterator[tuple[int, int, bool]]:
    """Yield first and last tick of each segment, and whether it is driven."""
    speeds, efforts = wheels.speeds[:, wheel], wheels.efforts[:, wheel]
    largest = float(np.abs(efforts).max())
    stepped = np.abs(np.diff(efforts, prepend=efforts[0])) > MAX_TORQUE_STEP * largest
    late = np.diff(wheels.times, prepend=wheels.times[0]) > 1.5 * np.median(np.diff(wheels.times))
    usable = (np.abs(speeds) > MIN_SPEED) & ~stepped & ~late
    driven = np.abs(efforts) > DRIVEN_SHARE * largest
    label = np.where(usable, np.sign(speeds) * (1 + driven), 0.0)
    edges = np.flatnonzero(np.diff(label)) + 1
    for begin, end in zip([0, *edges], [*edges, len(label)]):
        if label[begin] and end - begin >= MIN_SAMPLES:
            yield int(begin), int(end) - 1, bool(driven[begin])


def _regression(wheel: int, begin: int, end: int, driven: bool, links: LinkMeasurements,
                wheels: WheelMeasurements) -> _Regression:
    """Return the equations at the times of the link measurements."""
    ticks = wheels.times[begin:end + 1]
    theta = wheels.angles[begin:end + 1, wheel]
    inside = ((links.times >= ticks[0]) & (links.times <= ticks[-1])
              & np.isfinite(links.angles[:, wheel]))
    times = links.times[inside]
    period = np.diff(ticks)
    n = np.clip(np.searchsorted(ticks, times, side='right') - 1, 0, len(period) - 1)
    since = times - ticks[n]

    def double_integral(held: Floats) -> Floats:
        """Integrate twice a signal that is constant within each tick, up to `times`."""
        once = np.concatenate([[0.0], np.cumsum(held * period)])
        twice = np.concatenate([[0.0], np.cumsum(
            once[:-1] * period + 0.5 * held * period * period)])
        return np.asarray(twice[n] + once[n] * since + 0.5 * held[n] * since * since)

    # The spline passes through the encoder readings at the ticks.
    motion = CubicSpline(ticks, theta - theta[0])
    elapsed = times - ticks[0]
    sign = float(np.sign(theta[-1] - theta[0]))
    regressors = np.column_stack([
        double_integral(wheels.efforts[begin + 1:end + 1, wheel]),
        -0.5 * sign * elapsed * elapsed,
        -motion.antiderivative()(times),
        -sign * double_integral((MIN_SPEED / wheels.speeds[begin + 1:end + 1, wheel]) ** 2)])
    angles = motion(times) + links.angles[inside, wheel]
    # Eliminate the initial angle and rate of the segment.
    initial = np.linalg.qr(np.column_stack([np.ones_like(elapsed), elapsed]))[0]
    return _Regression(
        driven, times, motion(times, 1), regressors - initial @ (initial.T @ regressors),
        angles - initial @ (initial.T @ angles))


def mean_friction(estimates: Sequence[WheelEstimate]
                  ) -> tuple[ParameterEstimate, ParameterEstimate]:
    """
    Average the friction over the wheels; the controller has one value for all wheels.

    :returns: `bearing_coulomb` [N m] and `bearing_viscous` [N m s]; the standard error is that of
        the mean, without the variation between wheels.
    """
    count = len(estimates)
    coulomb, viscous = (
        ParameterEstimate(
            name, unit, sum(getattr(item, name.removeprefix('bearing_')) for item in estimates)
            / count, float(np.sqrt(sum(item.covariance[row, row] for item in estimates))) / count)
        for row, (name, unit) in enumerate(FRICTION, start=1))
    return coulomb, viscous
