# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters that every device has."""

from fourbar_ros.device.supervisor import TIMEOUT_ACTIONS
from fourbar_ros.ros.parameters import Parameter


def common_parameters(mechanism):
    """
    List the parameters that all devices have.

    :param mechanism: default of that parameter.
    """
    return (
        Parameter('mechanism', mechanism, '', 'preset or path of a mechanism file'),
        Parameter('rate', 250.0, 'Hz', 'control rate, one tick per period',
                  limits=(1.0, 2000.0)),
        Parameter('command_timeout', 0.1, 's', 'longest time without a command while armed',
                  limits=(0.002, 10.0)),
        Parameter('sensor_timeout', 0.2, 's', 'a link without a sample for so long is silent',
                  limits=(0.002, 10.0)),
        Parameter('timeout_action', 'coast', '', 'what the wheels do when commands stay away',
                  choices=TIMEOUT_ACTIONS),
    )
