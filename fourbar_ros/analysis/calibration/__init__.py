# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibration of a device from what it recorded: arrays in, estimates with intervals out.

Zeros of the link encoders from a known pose, wheels from spin-ups and coast-downs, links from an
excitation of all four. No ROS, no files.
"""
