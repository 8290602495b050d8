# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""One row of a node's table of parameters, and what its value may be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fourbar_ros.common.errors import FourbarError


class ParameterError(FourbarError):
    """A parameter value that is refused."""


@dataclass(frozen=True)
class Parameter:
    """
    One row of a node's table.

    :param default: also gives the type; a float takes whole numbers too.
    :param unit: SI, or '' for none.
    :param limits: smallest and largest allowed value, both inclusive.
    :param choices: all allowed values.
    :param live: may be changed at run time.
    """

    name: str
    default: Any
    unit: str
    meaning: str
    limits: tuple[float, float] | None = None
    choices: tuple[Any, ...] | None = None
    live: bool = False

    def checked(self, value: Any) -> Any:
        """
        Return the value in the parameter's type.

        :raises ParameterError: wrong type, out of range, not one of the choices.
        """
        kind = type(self.default)
        if kind is str and value is False:
            value = 'off'   # which is how YAML reads that word
        if kind is str and type(value) is int:
            value = str(value)   # as the channel of some bus adapters
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            raise ParameterError(
                f'parameter {self.name} must be of type {kind.__name__}, got {value!r}')
        if self.choices is not None and value not in self.choices:
            raise ParameterError(
                f'parameter {self.name} must be one of {", ".join(map(str, self.choices))}, '
                f'got {value}')
        # Written so that NaN fails.
        if self.limits is not None and not self.limits[0] <= value <= self.limits[1]:
            raise ParameterError(
                f'parameter {self.name} must be between {self.limits[0]:g} and '
                f'{self.limits[1]:g} {self.unit}'.rstrip() + f', got {value}')
        return value
