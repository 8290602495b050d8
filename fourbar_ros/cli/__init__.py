# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The `fourbar` command line: one module per command or group of commands."""
