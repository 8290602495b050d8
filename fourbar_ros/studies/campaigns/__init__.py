# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Campaigns of closed loops: what is drawn, made, kept and summed up (docs/campaigns.md)."""
