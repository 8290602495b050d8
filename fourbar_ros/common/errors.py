# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The root of every error that this package raises on purpose."""

from __future__ import annotations

from typing import Any, TypeVar

_Error = TypeVar('_Error', bound='FourbarError')


class FourbarError(Exception):
    """
    An error that a user can act on: what is wrong, where, and the limit.

    Commands print the message in one line on stderr and exit non-zero; nodes log it and exit.

    :param message: one line.
    :param values: what the message says, for programs: `name`, `value`, `limit`, `file`, ...
    :ivar values: the same. A program or a test reads these, never the wording of the message.
    """

    def __init__(self, message: str = '', /, **values: Any) -> None:
        super().__init__(message)
        self.values = values

    def at(self, place: object, kind: type[_Error]) -> _Error:
        """
        Return an error of another kind with the place in front of the message.

        :param place: the file or section that is refused.
        """
        return kind(f'{place}: {self}', **{'place': str(place), **self.values})
