# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A process that drives real hardware loads no simulated plant."""

import subprocess
import sys

import pytest

LIST_PLANT_MODULES = (
    'import sys, {module}\n'
    'print(*(name for name in sys.modules if name.startswith("fourbar_ros.plant")))')


@pytest.mark.slow
@pytest.mark.parametrize(('module', 'loads_plant'), [
    ('fourbar_ros.device', False), ('fourbar_ros.hardware.prototype', False),
    ('fourbar_ros.hardware.emulator', True)])
def test_only_the_emulator_loads_the_plant(module: str, loads_plant: bool) -> None:
    output = subprocess.run(
        [sys.executable, '-P', '-c', LIST_PLANT_MODULES.format(module=module)],
        check=True, capture_output=True, text=True).stdout
    assert bool(output.split()) is loads_plant
