# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Linkages and checks that many tests use."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from itertools import count
import os
from pathlib import Path
import re
from types import ModuleType
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism import load_mechanism, Mechanism
from hypothesis import settings
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

# The duration of an example is not a test: other tests run on the same machine.
settings.register_profile('patient', deadline=None)
settings.load_profile('patient')

# Passed tests per dot of a run with workers; one dot a test would hide failures.
PASSED_PER_DOT = 100
_passed = count(1)
# Niceness of computing tests, which leaves nine tenths of a shared processor to nodes.
NICE = 10


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give one worker all files whose tests start processes, and keep the others together."""
    from xdist.scheduler import LoadScopeScheduling

    class ScheduleByFile(LoadScopeScheduling):      # type: ignore[misc]
        """Scheduling of whole files; those whose tests start processes are one unit."""

        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition('::')[0]
            return 'processes' if has_processes(str(config.rootpath / file)) else file
    return ScheduleByFile(config, log)


@cache
def has_processes(file: str) -> bool:
    """Return whether a file marks tests that start processes."""
    return re.search(r'mark\.(node|package)\b', Path(file).read_text()) is not None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the tests that start processes first, beside the computing tests of the other worker."""
    items.sort(key=lambda item: has_processes(str(item.path)), reverse=True)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Lower the priority of a worker that only computes below the real-time nodes of the other."""
    if 'PYTEST_XDIST_WORKER' in os.environ and not has_processes(str(item.path)):
        os.nice(NICE - os.nice(0))


@pytest.hookimpl(tryfirst=True)
def pytest_report_teststatus(report: Any, config: pytest.Config) -> tuple[str, str, str] | None:
    """Show one dot for many passed tests in a run with workers."""
    if report.when == 'call' and report.passed and config.getoption('numprocesses', None):
        return 'passed', '' if next(_passed) % PASSED_PER_DOT else '.', 'PASSED'
    return None


@pytest.fixture(scope='session')
def paper() -> Mechanism:
    """Load the linkage of the paper."""
    return load_mechanism('paper')


@pytest.fixture(scope='session')
def uneven() -> Mechanism:
    """Make a linkage without equal parameters."""
    return Mechanism(  # type: ignore[arg-type]
        [0.12, 0.08, 0.11, 0.10], [0.02, 0.03, 0.025, 0.018], [2.2e-5, 1.5e-5, 3e-5, 1.8e-5],
        [[0.05, 0.01], [0.04, -0.01], [0.06, 0.005], [0.05, 0.0]], [3e-7, 4e-7, 5e-7, 2e-7],
        [1e-4] * 4, [500.0] * 4)


@pytest.fixture(scope='session')
def momentum_and_energy() -> Callable[[Mechanism, Array, Array, Array], tuple[float, float]]:
    """
    Return a function that sums angular momentum and kinetic energy over links and wheels.

    Its arguments are mechanism, link angles, link rates and absolute wheel speeds; both sums are
    about the mass centre of the whole linkage.
    """
    def sums(mechanism: Mechanism, angles: Array, rates: Array, wheels: Array
             ) -> tuple[float, float]:
        mass, turn, motion = mechanism.link_masses, np.exp(1j * angles), []
        for unit in (turn, 1j * rates * turn):
            arm, rod = mechanism.com_positions @ [1.0, 1j] * unit, mechanism.link_lengths * unit
            at = arm + [0.0, 0.0, rod[1], rod[0]]
            motion.append(at - mass @ at / mass.sum())
        place, velocity = motion
        momentum = (mechanism.link_inertias @ rates + mechanism.flywheel_inertias @ wheels
                    + mass @ (place.conj() * velocity).imag)
        energy = (mechanism.link_inertias @ rates**2 + mechanism.flywheel_inertias @ wheels**2
                  + mass @ np.abs(velocity)**2) / 2.0
        return float(momentum), float(energy)

    return sums


@contextmanager
def _refused(kind: type[FourbarError], /, **values: Any
             ) -> Iterator[pytest.ExceptionInfo[FourbarError]]:
    with pytest.raises(kind) as caught:
        yield caught
    found = {name: caught.value.values.get(name) for name in values}
    assert found == values, caught.value
    # Commands print the error in one line, and nodes log it in one line.
    assert len(str(caught.value).splitlines()) == 1


@pytest.fixture(scope='session')
def refuses() -> Callable[..., AbstractContextManager[pytest.ExceptionInfo[FourbarError]]]:
    """
    Return a context that expects an error of a type with given values.

    `with refuses(TableError, name='joints.viscous', value=-1.0): ...`; wording is not compared.
    """
    return _refused


@pytest.fixture(scope='session')
def synthetic() -> ModuleType:
    """Return the module that writes bags (tests are no package, so it cannot be imported)."""
    path = Path(__file__).parent / 'analysis' / 'synthetic.py'
    spec = spec_from_file_location('synthetic', path)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
