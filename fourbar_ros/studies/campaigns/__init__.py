# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Monte Carlo campaigns: files, random draws, worker processes, results (docs/campaigns.md)."""

from fourbar_ros.common.errors import FourbarError


class CampaignError(FourbarError):
    """A campaign that is refused, or that ends before all of its runs are finished."""
