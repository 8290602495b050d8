# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""One table per node lists its parameters; declaring, checking and documents come from it."""

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import SettingError
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult


def declare(node, table, changed=None):
    """
    Declare a table of parameters and read their first values.

    :param changed: called with the dict of all values before they change at run time; what it
        raises refuses the change.
    :returns: dict of values by name.
    :raises SettingError: a value given at start is refused.
    """
    rows = {row.name: row for row in table}
    values = {}
    for row in table:
        given = node.declare_parameter(row.name, row.default, ParameterDescriptor(
            description=f'{row.meaning} [{row.unit}]' if row.unit else row.meaning,
            read_only=not row.live, dynamic_typing=True)).value
        values[row.name] = row.check(given)

    def on_set(parameters):
        new = dict(values)
        for parameter in parameters:
            if parameter.name in rows:
                try:
                    new[parameter.name] = rows[parameter.name].check(parameter.value)
                except SettingError as error:
                    return SetParametersResult(successful=False, reason=str(error))
        if new != values:
            try:
                if changed is not None:
                    changed(new)
            except FourbarError as error:
                return SetParametersResult(successful=False, reason=str(error))
            values.update(new)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(on_set)
    return values
