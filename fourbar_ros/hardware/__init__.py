# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The prototype: four links on a bus, as the host sees them and as they are emulated."""
