# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Products of small matrices, as arrays.

Plain loops with a fixed order of each sum: results do not depend on the BLAS of the machine, and
for matrices of a dozen rows a call of BLAS takes longer than the product.
"""

from __future__ import annotations

from fourbar_ros.kernels.compiler import kernel
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@kernel
def product(a: Array, b: Array) -> Array:
    """Return the product a b."""
    total = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for m in range(a.shape[1]):
            for k in range(b.shape[1]):
                total[i, k] += a[i, m] * b[m, k]
    return total
