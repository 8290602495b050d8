# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The terms of the equations of motion, for controllers, estimators and studies.

Paper eq. 6 (`reduced_form`), Gamma, and the mass matrix of the four link angles. They come from
the kernels that integrate the motion (reduced.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.mechanism import Mechanism
from fourbar_ros.mechanism.reduced import gammas, LinkVectors, reduced_terms, ReducedTerms
import numpy as np
from numpy.typing import ArrayLike


class ChangePointError(FourbarError):
    """Gamma, and with it the reduced form, does not exist at a change point."""


@dataclass(frozen=True, eq=False)
class ReducedForm:
    """
    The terms of paper eq. 6, `A du + b = -G diag(If) s`, u = (omega_a, omega_b).

    :param mass_matrix: A (2, 2) [kg m^2].
    :param bias: b (2,) [N m].
    :param gamma: (2, 2), `(omega_c, omega_d) = gamma (omega_a, omega_b)`, rows c and d.
    """

    mass_matrix: Array
    bias: Array
    gamma: Array

    @property
    def wheel_map(self) -> Array:
        """Map link torques (a, b, c, d) to the two axes: G (2, 4)."""
        (g1, g2), (g3, g4) = self.gamma.tolist()
        return np.array([[1.0, 0.0, g1, g3], [0.0, 1.0, g2, g4]])


def reduced_form(mechanism: Mechanism, link_angles: ArrayLike, link_rates: ArrayLike
                 ) -> ReducedForm:
    """
    Evaluate paper eq. 6 (corrected as docs/mechanics.md says) for any linkage.

    :param link_angles: (4,) on the closure [rad].
    :param link_rates: (2,) omega_a, omega_b, or (4,), the last two ignored [rad/s].
    :raises ChangePointError: links c and d lie on a line, where Gamma does not exist.
    """
    angles = np.asarray(link_angles, dtype=float)
    rates = np.asarray(link_rates, dtype=float)
    if sin(angles[3] - angles[2]) == 0.0:
        raise ChangePointError('links c and d lie on a line: Gamma does not exist here')
    terms = reduced_terms_at(angles, rates, mechanism.constants)
    return ReducedForm(
        np.array([[terms.a00, terms.a01], [terms.a01, terms.a11]]),
        np.array([terms.b0, terms.b1]), np.array([[terms.g1, terms.g2], [terms.g3, terms.g4]]))


@kernel
def mass_matrix(angles: Array, constants: Constants) -> Array:
    """Evaluate M (4, 4) of the four link angles [kg m^2], without the wheels' axial inertia."""
    matrix = np.empty((4, 4))
    for j in range(4):
        for k in range(4):
            difference = angles[k] - angles[j]
            matrix[j, k] = (constants.cosine[j, k] * cos(difference)
                            + constants.sine[j, k] * sin(difference))
    return matrix


@kernel
def gamma_matrix(angles: Array, lengths: Array) -> Array:
    """Evaluate Gamma (2, 2) of four link angles: (omega_c, omega_d) = Gamma (omega_a, omega_b)."""
    links, inverse_fold = _vectors(angles, lengths)
    g1, g2, g3, g4 = gammas(links, inverse_fold, lengths)
    return np.array([[g1, g2], [g3, g4]])


@kernel
def reduced_terms_at(angles: Array, rates: Array, constants: Constants) -> ReducedTerms:
    """Evaluate `reduced_terms` from the four link angles."""
    links, inverse_fold = _vectors(angles, constants.lengths)
    return reduced_terms(links, inverse_fold, rates[0], rates[1], constants)


@kernel
def _vectors(angles: Array, lengths: Array) -> tuple[LinkVectors, float]:
    """Return the links and the inverse of the fold, as `close_loop` does from theta."""
    b, c, d = angles[1] - angles[0], angles[2] - angles[0], angles[3] - angles[0]
    l_c, l_d = lengths[2], lengths[3]
    return (LinkVectors(cos(b), sin(b), l_c * cos(c), l_c * sin(c), l_d * cos(d), l_d * sin(d)),
            1.0 / (l_c * l_d * sin(d - c)))
