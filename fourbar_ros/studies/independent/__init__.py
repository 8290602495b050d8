# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The linkage by other people's means, to hold ours against.

Nothing here uses the equations of `fourbar_ros.mechanism`, only its parameters and conventions.
"""

from importlib import import_module


def installed(library: str) -> bool:
    """Tell whether an engine's library can be imported here."""
    try:
        import_module(library)
    except ImportError:
        return False
    return True
