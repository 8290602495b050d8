# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The schema of settings: one declaration per setting, as metadata of a dataclass field.

From a declaration come the settings object, the check of its values, the ROS parameter with its
range, the keys of YAML files, and the tables of the docs. A class of settings reads::

    @dataclass(frozen=True)
    class Joints(Settings):
        viscous: float = setting(0.0, 'N m s', 'torque per relative rate', low=0.0)

`dataclasses` is enough for that: the schema needs no other library at run time, and its classes
import in microseconds, which matters for every command.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, MISSING
from math import inf, isfinite
import re
from typing import Any, ClassVar, TypeVar

from fourbar_ros.common.errors import FourbarError

_Settings = TypeVar('_Settings', bound='Settings')
_LONGEST_QUOTE = 40
"""Characters of a refused value in a message; a user may paste anything."""


class SettingError(FourbarError):
    """
    A value that a setting refuses.

    Its `values` are `name`, `value` and `limit`: a type, a tuple of choices, or `(low, high)`.
    """


@dataclass(frozen=True)
class Setting:
    """
    Declaration of one setting.

    :param name: key in files and name of the ROS parameter; the field sets it.
    :param default: also gives the kind where none is given; MISSING where a value is required.
    :param unit: SI, or '' for none.
    :param meaning: what it is, for docs, templates and `ros2 param describe`.
    :param low, high: smallest and largest value, both allowed.
    :param above: value must be larger than this.
    :param choices: all allowed values.
    :param live: whether it may be changed at run time.
    :param kind: float, int, bool or str. A float takes whole numbers too.
    :param infinite: whether inf is a value.
    """

    name: str
    default: Any
    unit: str
    meaning: str
    low: float = -inf
    high: float = inf
    above: float = -inf
    choices: tuple[Any, ...] | None = None
    live: bool = False
    kind: Any = None
    infinite: bool = False

    def __post_init__(self) -> None:
        """Take the type from the default."""
        if self.kind is None:
            object.__setattr__(self, 'kind', type(self.default))

    @property
    def limits(self) -> tuple[float, float] | None:
        """Smallest and largest value, None where neither is limited."""
        low = max(self.low, self.above)
        return None if (low, self.high) == (-inf, inf) else (low, self.high)

    @property
    def allowed(self) -> str:
        """What is allowed, in words, '' for anything of the type."""
        if self.choices is not None:
            return f'one of {", ".join(map(str, self.choices))}'
        if self.above > -inf:
            return f'above {self.above:g}' + (f' and at most {self.high:g}' if self.high < inf
                                              else '')
        if self.high < inf:
            return (f'between {self.low:g} and {self.high:g}' if self.low > -inf
                    else f'at most {self.high:g}')
        return f'at least {self.low:g}' if self.low > -inf else ''

    def check(self, value: Any, name: str = '') -> Any:
        """
        Return a value in the type of the setting.

        :param name: what the message calls it, by default the name of the setting.
        :raises SettingError: wrong type, not finite, out of range, or not one of the choices.
        """
        name = name or self.name
        kind = self.kind
        # YAML reads `off` as false, and the channel of some bus adapters as a number.
        if kind is str and value is False:
            value = 'off'
        if kind is str and type(value) is int:
            value = str(value)
        if kind is int and type(value) is float and value.is_integer():
            value = int(value)
        if kind is float and type(value) is int:
            value = _as_float(value)
        elif kind is float and isinstance(value, float):
            value = float(value)    # numpy's scalar is a subclass
        quoted = _quoted(value)
        if type(value) is not kind:
            raise SettingError(f'{name} must be {_KINDS[kind]}, got {quoted}',
                               name=name, value=value, limit=kind)
        if self.choices is not None:
            if value not in self.choices:
                raise SettingError(f'{name} must be {self.allowed}, got {quoted}',
                                   name=name, value=value, limit=self.choices)
        elif kind in (int, float):
            infinite = self.infinite and value == inf
            # Written so that NaN fails.
            if not (infinite or isfinite(value) and self.low <= value <= self.high
                    and value > self.above):
                raise SettingError(
                    f'{name} must be {self.allowed or "finite"} {self.unit}'.rstrip()
                    + f', got {quoted}', name=name, value=value,
                    limit=self.limits or (-inf, inf))
        return value

    def check_each(self, values: Any, elements: Sequence[str], name: str = '',
                   inner: Sequence[str] = ()) -> list[Any]:
        """
        Return the values of a list or array, each in the type of the setting.

        :param elements: name of each element; messages call it `name.element`.
        :param name: as of `check`.
        :param inner: where the elements are lists themselves, the names of their elements.
        :raises SettingError: no list, of another length (`limit` is the right one), or an element
            is refused.
        """
        name = name or self.name
        if isinstance(values, (str, bytes, Mapping)) or not isinstance(values, Iterable):
            raise SettingError(f'{name} must be a list of {len(elements)}, got {_quoted(values)}',
                               name=name, value=values, limit=list)
        listed = list(values)
        if len(listed) != len(elements):
            raise SettingError(
                f'{name} must hold {len(elements)} values ({", ".join(elements)}), got '
                f'{len(listed)}', name=name, value=len(listed), limit=len(elements))
        return [self.check_each(value, inner, f'{name}.{element}') if inner
                else self.check(value, f'{name}.{element}')
                for value, element in zip(listed, elements)]


_KINDS = {float: 'a number', int: 'a whole number', bool: 'true or false', str: 'text'}


def setting(default: Any, unit: str, meaning: str, **declared: Any) -> Any:
    """
    Declare a field of a :class:`Settings` class.

    :param default, unit, meaning: see :class:`Setting`; MISSING for a required value.
    :param declared: the other attributes of :class:`Setting`.
    """
    return field(default=default, metadata={
        'setting': Setting('', default, unit, meaning, **declared)})


@dataclass(frozen=True)
class Settings:
    """
    Base of the classes of settings: values are checked when an object is made.

    :cvar section: name of the settings in files and messages, '' for none.
    :raises SettingError: a value is refused.
    """

    section: ClassVar[str] = ''

    def __post_init__(self) -> None:
        """Check every declared value, and take it over in its type."""
        for row in settings_of(type(self)):
            name = f'{self.section}.{row.name}' if self.section else row.name
            object.__setattr__(self, row.name, row.check(getattr(self, row.name), name))

    @classmethod
    def from_mapping(cls: type[_Settings], values: Any, place: str = '') -> _Settings:
        """
        Make settings from the keys of a section; what is left out has its default.

        :param place: where the section is, for messages, by default its name.
        :raises SettingError: not a mapping, a key is missing or unknown, or a value is refused.
        """
        place = place or cls.section
        if not isinstance(values, Mapping):
            raise SettingError(f'{place} must hold keys of its own, got {_quoted(values)}',
                               name=place, value=values, limit=dict)
        rows = settings_of(cls)
        check_keys(values, [row.name for row in rows if row.default is MISSING], place,
                   SettingError, optional=[row.name for row in rows])
        if place and not cls.section:
            for row in rows:
                if row.name in values:
                    row.check(values[row.name], f'{place}.{row.name}')
        return cls(**values)


def settings_of(kind: type[Any], prefix: str = '') -> tuple[Setting, ...]:
    """
    Return the declarations of a class of settings, in the order of its fields.

    :param prefix: put in front of each name, as `initial.`.
    """
    return tuple(_rows(kind, prefix))


def _rows(kind: type[Any], prefix: str) -> Iterator[Setting]:
    for item in fields(kind):
        declared = item.metadata.get('setting')
        if declared is not None:
            attributes = {**vars(declared), 'name': prefix + item.name}
            if declared.kind is type(MISSING):
                # The annotation is text where a module postpones its evaluation.
                attributes['kind'] = _TYPES.get(str(item.type), item.type)
            yield Setting(**attributes)


_TYPES: dict[str, type[Any]] = {'float': float, 'int': int, 'bool': bool, 'str': str}


def check_keys(values: Mapping[str, Any], required: Collection[str], place: str,
               error: type[FourbarError], optional: Collection[str] = ()) -> None:
    """
    Refuse a mapping that lacks a key or has an unknown one.

    :param place: where the mapping is, for the message.
    :param error: what to raise; its `values` are `missing` or `unknown` (names) and `place`.
    """
    if missing := sorted(set(required) - set(values)):
        raise error(f'{place}: {", ".join(missing)} missing', missing=missing, place=place)
    known = {*required, *optional}
    if unknown := sorted(set(map(str, values)) - known):
        raise error(
            f'{place}: unknown {_shortened(", ".join(unknown))} (known are '
            f'{", ".join(sorted(known))})', unknown=unknown, place=place)


def _as_float(value: int) -> Any:
    """Return a float, or the whole number itself where it is too large for one."""
    try:
        return float(value)
    except OverflowError:
        return inf if value > 0 else -inf


def _quoted(value: object) -> str:
    """Return a refused value in at most one short line."""
    if type(value) is int and abs(value).bit_length() > 64:
        return f'a whole number of {value.bit_length()} bits'
    return _shortened(re.sub(r'\s+', ' ', repr(value)))


def _shortened(text: str) -> str:
    return text if len(text) <= _LONGEST_QUOTE else text[:_LONGEST_QUOTE - 3] + '...'
