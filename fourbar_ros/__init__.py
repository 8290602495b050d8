# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Simulate, estimate, control and drive a free-floating four-bar linkage with flywheels."""

__version__ = '0.1.0'
