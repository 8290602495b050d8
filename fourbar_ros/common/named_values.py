# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers that come in by the names of links or wheels: taken whole or rejected whole."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from fourbar_ros.common.errors import FourbarError


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
