# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameter identification from recorded measurements: arrays in, estimates with intervals out.

Offsets of the link encoders from a known pose, wheel parameters from spin-ups and coast-downs,
link parameters from a multi-sine excitation of all wheels. No ROS, no files.
"""
