# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The root of every error that this package raises on purpose."""


class FourbarError(Exception):
    """
    Something a user can act on: what is wrong, where, and the limit.

    Commands print the message in one line on stderr and exit non-zero; nodes log it and exit.
    """
