# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Thin ROS shells, one per executable, and the ROS side of the commands: the only rclpy."""
