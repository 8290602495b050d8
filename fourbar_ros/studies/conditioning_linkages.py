# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Linkages of paper Fig. 6, their condition numbers, and a linkage over its configurations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.conditioning import Conditioning, conditioning_grid
from fourbar_ros.mechanism.constants import Array
import numpy as np
from scipy.optimize import brentq

LENGTH = 0.1    # of link b, and of all links where lengths are equal [m]
MASS, INERTIA, WHEEL_INERTIA = 0.02, 2.2e-5, 3.4e-7
SQUARE = np.pi / 2.0

POINTS = 200
# Symmetric about 90 deg; contains no change point.
THETAS = np.pi * (np.arange(POINTS) + 0.5) / POINTS
RATIOS = np.geomspace(0.25, 4.0, POINTS)
OFFSETS = np.linspace(-0.05, 0.05, POINTS)

# Sign conventions of the offsets of links a, b, c, d.
SIGNS: dict[str, tuple[float, ...]] = {
    'same': (1.0, 1.0, 1.0, 1.0), 'inside': (1.0, -1.0, -1.0, 1.0)}

# Limit of cond(A) for the spans of offsets.
STABLE = 1.5
SPAN_OFFSETS = np.linspace(0.0, 0.1, 101)
"""Offsets between which the end of a span is located, up to a whole link [m]."""


@dataclass(frozen=True, eq=False)
class LinkageConditioning:
    """
    A linkage over its configurations.

    :param title: name in tables and figures.
    :param thetas: (n,) [rad].
    :param branches: conditioning by branch.
    """

    title: str
    thetas: Array
    branches: Mapping[str, Conditioning]


def linkage_conditioning(title: str, mechanism: Mechanism, thetas: Array,
                         branches: tuple[str, ...] = ('open',)) -> LinkageConditioning:
    """Evaluate a linkage at all thetas on the given branches."""
    return LinkageConditioning(title, thetas, {
        branch: conditioning_grid([mechanism], thetas, branch) for branch in branches})


def uniform_links(lengths: Array, offsets: Array | float = 0.0, mass_scale: Array | float = 1.0
                  ) -> Mechanism:
    """
    Make a linkage of the paper's links with other lengths.

    :param lengths: (4,) [m].
    :param offsets: (4,) of the mass centres across the links [m].
    :param mass_scale: (4,) factor of the masses; inertias scale with its cube.
    """
    scale = np.broadcast_to(mass_scale, 4)
    return Mechanism(
        lengths, MASS * scale, INERTIA * scale ** 3,
        np.column_stack([0.5 * lengths, np.broadcast_to(offsets, 4)]), np.full(4, WHEEL_INERTIA))


def parallelogram(ratio: float, with_length: bool = False) -> Mechanism:
    """
    Make a parallelogram of uniform links with l_b = 0.1 m by its ratio l_a / l_b.

    :param with_length: mass and inertia of links a and c scale with their length; by default they
        are those of the other links, as in the paper.
    """
    scale = np.array([ratio, 1.0, ratio, 1.0])
    return uniform_links(LENGTH * scale, mass_scale=scale if with_length else 1.0)


def rhombus(signs: tuple[float, ...], offset: float) -> Mechanism:
    """Make a rhombus of the paper's links with mass centres off the line of their joints [m]."""
    return uniform_links(np.full(4, LENGTH), offset * np.array(signs))


def condition(mechanism: Mechanism, theta: float) -> float:
    """Return cond(A) of a linkage in one configuration [rad], on the open branch."""
    return float(conditioning_grid([mechanism], [theta]).condition[0, 0])


def ratio_grid() -> Conditioning:
    """Evaluate the grid of Fig. 6a: `RATIOS` by `THETAS`."""
    return conditioning_grid([parallelogram(ratio) for ratio in RATIOS], THETAS)


def offset_grid(signs: tuple[float, ...]) -> Conditioning:
    """Evaluate the grid of Fig. 6b: `OFFSETS` by `THETAS`."""
    return conditioning_grid([rhombus(signs, offset) for offset in OFFSETS], THETAS)


def span(signs: tuple[float, ...], theta: float) -> float:
    """Return the offset up to which cond(A) is at most `STABLE` [m]; inf beyond a whole link."""
    def excess(offset: float) -> float:
        return condition(rhombus(signs, offset), theta) - STABLE
    values = conditioning_grid(
        [rhombus(signs, offset) for offset in SPAN_OFFSETS], [theta]).condition
    if (values <= STABLE).all():
        return np.inf
    # The first end: offsets towards the inside have a worst value, beyond which cond falls again.
    first = int(np.argmax(values > STABLE))
    return float(brentq(excess, SPAN_OFFSETS[first - 1], SPAN_OFFSETS[first], xtol=1e-9))


def worst_of_three(conditioning: Conditioning) -> Array:
    """Return the gain of three wheels after the loss of the most important one (m, n)."""
    worst: Array = conditioning.gains[..., 1:5].min(axis=-1)
    return worst
