# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Analysis of recorded bags: metrics and report, replay of the estimator, calibration."""
