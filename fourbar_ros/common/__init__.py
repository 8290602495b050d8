# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What every room may use: errors, settings, files in and out, names, the monotonic clock."""
