# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Values given by the names of links or wheels: a message is accepted or rejected as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from fourbar_ros.common.errors import FourbarError


class RejectedError(FourbarError):
    """
    A rejected message.

    :ivar kind: category of the reason, one word, for counters.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message, kind=kind)
        self.kind = kind


def values_by_name(names: Sequence[str], values: Sequence[float], known: Sequence[str],
                   quantity: str) -> dict[int, float]:
    """
    Map values to the indices of their names.

    :param names: names of a message: some of the known ones in any order, none repeated.
    :param values: a finite number for each name.
    :param known: all names, in their order.
    :param quantity: what the values are, for messages.
    :returns: value by index of its name in `known`, in the order of the message.
    :raises RejectedError: of kind `length`, `names` or `finite`.
    """
    if not len(names):
        raise RejectedError('length', 'no name is given')
    if len(names) != len(values):
        raise RejectedError('length', f'{len(names)} names but {len(values)} of {quantity}')
    result: dict[int, float] = {}
    for name, value in zip(names, values):
        if name not in known:
            raise RejectedError('names', f'unknown name {name!r} (known are {", ".join(known)})')
        index = known.index(name)
        if index in result:
            raise RejectedError('names', f'{name} is given twice')
        if not isfinite(value):
            raise RejectedError('finite', f'{quantity} of {name} is {value}')
        result[index] = float(value)
    return result
