# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Import of filterpy's extended Kalman filter alone.

`import filterpy.kalman` runs the whole of filterpy, and with it `scipy.stats`, `scipy.optimize`
and `scipy.ndimage` (and matplotlib, in some versions): a second in every process with an
estimator. The module of the extended Kalman filter needs two helpers of `filterpy.common`, and
`scipy.stats` only for its `log_likelihood`. So this module imports it with placeholders for its
parent packages, and then removes the placeholders: a later `import filterpy` gets the real
packages and this same class.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
import sys
from types import ModuleType
from typing import Any

_MODULE = 'filterpy.kalman.EKF'


def _log_density(*args: Any, **kwargs: Any) -> float:
    """Call `filterpy.stats.logpdf`, imported on first use."""
    return float(import_module('filterpy.stats').logpdf(*args, **kwargs))


def _placeholders(folder: Path) -> dict[str, ModuleType]:
    """Return empty packages by their names, whose modules are found in the folder of filterpy."""
    packages = {}
    for name in ('filterpy', 'filterpy.kalman', 'filterpy.stats'):
        packages[name] = ModuleType(name)
        packages[name].__path__ = [str(folder.joinpath(*name.split('.')[1:]))]
    packages['filterpy.stats'].__dict__['logpdf'] = _log_density
    return packages


def _import() -> ModuleType:
    spec = find_spec('filterpy')
    if 'filterpy' in sys.modules or spec is None or not spec.submodule_search_locations:
        return import_module(_MODULE)
    packages = _placeholders(Path(spec.submodule_search_locations[0]))
    sys.modules.update(packages)
    try:
        return import_module(_MODULE)
    finally:
        for name in packages:
            del sys.modules[name]


ExtendedKalmanFilter: Any = _import().ExtendedKalmanFilter
