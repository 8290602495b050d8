# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Typed records that Python and the kernels share, with fields by name."""

from __future__ import annotations

from typing import Any, cast, TypeAlias

import numpy as np
from numpy.typing import NDArray

# Name, type and shape of each field; eight bytes per number keep records aligned.
Fields: TypeAlias = list[tuple[str, type, tuple[int, ...]]]

# An element of :func:`records` inside a kernel.
Record: TypeAlias = Any


def records(fields: Fields, count: int = 1) -> NDArray[np.record]:
    """Return an array of shape (count,) with zeroed records, as kernels take it."""
    return cast(NDArray[np.record], np.zeros(count, np.dtype((np.record, fields))))
