# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Linkages and checks that many tests use."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism import load_mechanism, Mechanism
from hypothesis import settings
import pytest

# How long an example takes is no law of nature: other tests run on the same machine.
settings.register_profile('patient', deadline=None)
settings.load_profile('patient')


@pytest.fixture(scope='session')
def paper() -> Mechanism:
    """Load the linkage of the paper."""
    return load_mechanism('paper')


@pytest.fixture(scope='session')
def uneven() -> Mechanism:
    """Make a linkage with nothing equal to anything else."""
    return Mechanism(  # type: ignore[arg-type]
        [0.12, 0.08, 0.11, 0.10], [0.02, 0.03, 0.025, 0.018], [2.2e-5, 1.5e-5, 3e-5, 1.8e-5],
        [[0.05, 0.01], [0.04, -0.01], [0.06, 0.005], [0.05, 0.0]], [3e-7, 4e-7, 5e-7, 2e-7],
        [1e-4] * 4, [500.0] * 4)


@contextmanager
def _refused(kind: type[FourbarError], **values: Any) -> Iterator[None]:
    with pytest.raises(kind) as caught:
        yield
    found = {name: caught.value.values.get(name) for name in values}
    assert found == values, caught.value
    # One line, as commands print it and nodes log it.
    assert len(str(caught.value).splitlines()) == 1


@pytest.fixture(scope='session')
def refuses() -> Callable[..., AbstractContextManager[None]]:
    """
    Return a context that expects an error of a type, with these of its values.

    `with refuses(TableError, name='joints.viscous', value=-1.0): ...`; wording is not compared.
    """
    return _refused
