# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""How well a share is known that was counted in runs."""

from __future__ import annotations

from scipy.stats import beta


def share_interval(count: int, runs: int) -> tuple[float, float]:
    """
    Return the 95 % confidence interval of a share (Clopper and Pearson 1934).

    :param count: of the runs that are so.
    :param runs: all of them.
    """
    others = runs - count
    low = float(beta.ppf(0.025, count, others + 1)) if count else 0.0
    high = float(beta.ppf(0.975, count + 1, others)) if others else 1.0
    return low, high
