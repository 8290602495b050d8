# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Inertia and bearing friction of a wheel, from spin-ups and coast-downs.

With `p = theta + phi`, wheel angle plus link angle, the motion of the wheel is
`I ddp/dt^2 = effort - coulomb sign(speed) - viscous speed`. Integrated twice it is linear in
1/I, coulomb/I and viscous/I, and nothing that an encoder rounds is ever differentiated:

    p = p0 + h0 t + (1/I) int int effort - (coulomb/I) s t^2/2 - (viscous/I) int (theta - theta_0)

The links may move as they like: their angles are measured. Static friction falls off with the
square of the speed (`mechanism.forces.grip`); what is left of it gets a term of its own, since a
thousandth of the Coulomb friction is more than the noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.quantity import (
    CalibrationError,
    correlation_factor,
    Quantity,
)
from fourbar_ros.analysis.calibration.signals import LinkSignal, WheelSignal
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism
import numpy as np
from scipy.interpolate import CubicSpline

# Below this a bearing knows static friction, which falls off within a few rad/s [rad/s].
SLOWEST = 15.0
# A torque that changes by more than this share of the largest within a tick ends a piece: the
# motor's lag inside the tick is not on record.
STEP = 0.05
# A wheel that was driven with less was not driven: share of its largest effort.
DRIVEN = 0.2
FEWEST = 25


@dataclass(frozen=True, eq=False)
class Piece:
    """
    A stretch of motion in one direction, without a step of the torque.

    :param driven: whether the motor worked.
    :param times: (n,) where the link was measured [s].
    :param speeds: (n,) of the wheel there [rad/s].
    :param residuals: (n,) of wheel angle plus link angle [rad].
    """

    driven: bool
    times: Floats
    speeds: Floats
    residuals: Floats


@dataclass(frozen=True, eq=False)
class WheelEstimate:
    """
    What was found of one wheel.

    :param wheel: its index.
    :param inertia: axial [kg m^2].
    :param coulomb: friction of the bearing [N m].
    :param viscous: of the same [N m s].
    :param covariance: (3, 3) of these in this order.
    :param pieces: what they were fitted to.
    """

    wheel: int
    inertia: float
    coulomb: float
    viscous: float
    covariance: Floats
    pieces: tuple[Piece, ...]

    def quantities(self, mechanism: Mechanism) -> list[Quantity]:
        """Return the three with their intervals."""
        name, errors = FLYWHEEL_NAMES[self.wheel], np.sqrt(np.diag(self.covariance))
        return [
            Quantity(f'{name} inertia', 'kg m^2', self.inertia, float(errors[0]),
                     float(mechanism.flywheel_inertias[self.wheel])),
            Quantity(f'{name} coulomb', 'N m', self.coulomb, float(errors[1])),
            Quantity(f'{name} viscous', 'N m s', self.viscous, float(errors[2]))]


def wheels_moved(wheels: WheelSignal) -> list[int]:
    """Return the wheels that were driven and turned faster than `SLOWEST`."""
    return [wheel for wheel in range(4)
            if np.abs(wheels.speeds[:, wheel]).max() > SLOWEST
            and np.abs(wheels.efforts[:, wheel]).max() > 0.0]


def wheel_estimate(wheel: int, links: LinkSignal, wheels: WheelSignal) -> WheelEstimate:
    """
    Estimate inertia and friction of one wheel.

    :param wheel: its index.
    :raises CalibrationError: the recording has no spin-up or no coast-down of it, or these do not
        tell inertia and friction apart.
    """
    rows = [_rows(wheel, begin, end, driven, links, wheels)
            for begin, end, driven in _pieces(wheel, wheels)]
    rows = [row for row in rows if len(row.angles) >= FEWEST]
    for driven, what in ((True, 'spin-up'), (False, 'coast-down')):
        if not any(row.driven is driven for row in rows):
            raise CalibrationError(
                f'no {what} of {FLYWHEEL_NAMES[wheel]} faster than {SLOWEST:g} rad/s is on record')
    columns = np.vstack([row.columns for row in rows])
    scale = np.linalg.norm(columns, axis=0)
    left, singular, right = np.linalg.svd(columns / scale, full_matrices=False)
    if not singular[-1] > 1e-6 * singular[0]:
        raise CalibrationError(
            f'the motion of {FLYWHEEL_NAMES[wheel]} does not tell its inertia and friction '
            'apart: spin it up to a higher speed and let it coast down further')
    angles = np.concatenate([row.angles for row in rows])
    x = right.T @ (left.T @ angles / singular) / scale
    pieces = tuple(Piece(row.driven, row.times, row.speeds, row.angles - row.columns @ x)
                   for row in rows)
    freedom = len(angles) - len(x) - 2 * len(rows)
    variance = sum(float(piece.residuals @ piece.residuals) for piece in pieces) / freedom
    variance *= correlation_factor([piece.residuals for piece in pieces])
    inverse = right.T / singular / scale[:, None]
    inertia, coulomb, viscous = (float(value / x[0]) for value in (1.0, x[1], x[2]))
    jacobian = np.array([[-inertia, 0.0, 0.0, 0.0], [-coulomb, 1.0, 0.0, 0.0],
                         [-viscous, 0.0, 1.0, 0.0]]) / x[0]
    return WheelEstimate(
        wheel, inertia, coulomb, viscous,
        variance * jacobian @ inverse @ inverse.T @ jacobian.T, pieces)


@dataclass(frozen=True, eq=False)
class _Rows:
    """The equations of one piece, its own start taken out: columns (n, 4) x = angles (n,)."""

    driven: bool
    times: Floats
    speeds: Floats
    columns: Floats
    angles: Floats


def _pieces(wheel: int, wheels: WheelSignal) -> Iterator[tuple[int, int, bool]]:
    """Find first and last tick of stretches in one direction and without steps of the torque."""
    speeds, efforts = wheels.speeds[:, wheel], wheels.efforts[:, wheel]
    largest = float(np.abs(efforts).max())
    stepped = np.abs(np.diff(efforts, prepend=efforts[0])) > STEP * largest
    late = np.diff(wheels.times, prepend=wheels.times[0]) > 1.5 * np.median(np.diff(wheels.times))
    good = (np.abs(speeds) > SLOWEST) & ~stepped & ~late
    driven = np.abs(efforts) > DRIVEN * largest
    label = np.where(good, np.sign(speeds) * (1 + driven), 0.0)
    edges = np.flatnonzero(np.diff(label)) + 1
    for begin, end in zip([0, *edges], [*edges, len(label)]):
        if label[begin] and end - begin >= FEWEST:
            yield int(begin), int(end) - 1, bool(driven[begin])


def _rows(wheel: int, begin: int, end: int, driven: bool, links: LinkSignal,
          wheels: WheelSignal) -> _Rows:
    """Set up the equations at the instants where the link was measured."""
    ticks = wheels.times[begin:end + 1]
    theta = wheels.angles[begin:end + 1, wheel]
    inside = ((links.times >= ticks[0]) & (links.times <= ticks[-1])
              & np.isfinite(links.angles[:, wheel]))
    times = links.times[inside]
    period = np.diff(ticks)
    n = np.clip(np.searchsorted(ticks, times, side='right') - 1, 0, len(period) - 1)
    since = times - ticks[n]

    def twice(held: Floats) -> Floats:
        """Integrate twice what is constant within each tick, up to the instants."""
        once = np.concatenate([[0.0], np.cumsum(held * period)])
        done = np.concatenate([[0.0], np.cumsum(
            once[:-1] * period + 0.5 * held * period * period)])
        return np.asarray(done[n] + once[n] * since + 0.5 * held[n] * since * since)

    # A cubic through the encoder's readings adds nothing at the ticks themselves.
    motion = CubicSpline(ticks, theta - theta[0])
    elapsed = times - ticks[0]
    sign = float(np.sign(theta[-1] - theta[0]))
    columns = np.column_stack([
        twice(wheels.efforts[begin + 1:end + 1, wheel]),
        -0.5 * sign * elapsed * elapsed,
        -motion.antiderivative()(times),
        -sign * twice((SLOWEST / wheels.speeds[begin + 1:end + 1, wheel]) ** 2)])
    angles = motion(times) + links.angles[inside, wheel]
    # Where and how fast the piece began is its own, and of no interest.
    start = np.linalg.qr(np.column_stack([np.ones_like(elapsed), elapsed]))[0]
    return _Rows(
        driven, times, motion(times, 1), columns - start @ (start.T @ columns),
        angles - start @ (start.T @ angles))


def friction_of_all(estimates: Sequence[WheelEstimate]) -> tuple[Quantity, Quantity]:
    """
    Average the friction over the wheels, as the controller has one value for all.

    :returns: `bearing_coulomb` [N m] and `bearing_viscous` [N m s]; the standard error is that of
        the mean, and not the spread of the wheels.
    """
    count = len(estimates)
    return tuple(  # type: ignore[return-value]
        Quantity(name, unit, sum(getattr(one, attribute) for one in estimates) / count,
                 float(np.sqrt(sum(one.covariance[row, row] for one in estimates))) / count)
        for row, (name, unit, attribute) in enumerate((
            ('bearing_coulomb', 'N m', 'coulomb'),
            ('bearing_viscous', 'N m s', 'viscous')), start=1))
