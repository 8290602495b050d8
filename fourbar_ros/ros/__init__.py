# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The ROS nodes, one module per executable, and what they share."""
