# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Tools of an operator over ROS: service calls, setpoints, recordings, experiments."""
