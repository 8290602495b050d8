# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The parameters that every device has."""

from fourbar_ros.device.testbed import TIMEOUT_ACTIONS
from fourbar_ros.nodes.parameters import Parameter


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
