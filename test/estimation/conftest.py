# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Linkages for the filter."""

from fourbar_ros.mechanism import Mechanism
import pytest


@pytest.fixture(params=['paper', 'uneven'])
def mechanism(request: pytest.FixtureRequest) -> Mechanism:
    """Return the linkage of the paper, then one without any symmetry."""
    linkage: Mechanism = request.getfixturevalue(request.param)
    return linkage
