# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Bags in, metrics, figures and reports out; without ROS."""
