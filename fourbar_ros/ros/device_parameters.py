# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters that every device has."""

from fourbar_ros.common.settings import Setting, settings_of
from fourbar_ros.device import SupervisorSettings


def common_parameters(mechanism):
    """
    List the parameters that all devices have.

    :param mechanism: default of that parameter.
    """
    return (
        Setting('mechanism', mechanism, '', 'preset or path of a mechanism file'),
        *settings_of(SupervisorSettings),
    )
