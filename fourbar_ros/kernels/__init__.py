# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Compilation of the numerical kernels, their linear algebra and their Runge-Kutta step."""
