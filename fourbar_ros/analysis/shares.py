# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
