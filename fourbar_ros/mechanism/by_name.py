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

"""Numbers that come in by the names of links or wheels: taken whole or rejected whole."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from fourbar_ros.errors import FourbarError


class RejectedError(FourbarError):
    """
    A message that is rejected.

    :ivar kind: one word for counting.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def values_by_name(names: Sequence[str], values: Sequence[float], known: Sequence[str],
                   quantity: str) -> dict[int, float]:
    """
    Look up names, and check what comes with them.

    :param names: some of the known ones, in any order, none of them twice.
    :param values: a finite number for each.
    :param known: in their order.
    :param quantity: what the numbers are, for messages.
    :returns: number by index of the name among the known ones, in the order given.
    :raises RejectedError: anything else; kinds `length`, `names`, `finite`.
    """
    if not len(names):
        raise RejectedError('length', 'nothing is named')
    if len(names) != len(values):
        raise RejectedError('length', f'{len(names)} names but {len(values)} of {quantity}')
    found: dict[int, float] = {}
    for name, value in zip(names, values):
        if name not in known:
            raise RejectedError('names', f'unknown name {name!r} (known are {", ".join(known)})')
        index = known.index(name)
        if index in found:
            raise RejectedError('names', f'{name} is named twice')
        if not isfinite(value):
            raise RejectedError('finite', f'{quantity} of {name} is {value}')
        found[index] = float(value)
    return found
