# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters that every device has."""

from fourbar_ros.common.settings import Setting
from fourbar_ros.device.supervisor import TIMEOUT_ACTIONS


def common_parameters(mechanism):
    """
    List the parameters that all devices have.

    :param mechanism: default of that parameter.
    """
    return (
        Setting('mechanism', mechanism, '', 'preset or path of a mechanism file'),
        Setting('rate', 250.0, 'Hz', 'control rate, one tick per period',
                  low=1.0, high=2000.0),
        Setting('command_timeout', 0.1, 's', 'longest time without a command while armed',
                  low=0.002, high=10.0),
        Setting('sensor_timeout', 0.2, 's', 'a link without a sample for so long is silent',
                  low=0.002, high=10.0),
        Setting('timeout_action', 'coast', '', 'what the wheels do when commands stay away',
                  choices=TIMEOUT_ACTIONS),
    )
