# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What an operator does over ROS: calls, setpoints, recordings, experiments."""
