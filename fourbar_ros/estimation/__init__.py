# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What we believe: the Kalman filter on link angles and wheel motion."""

from fourbar_ros.estimation.estimate import Decision, DECISIONS, Estimate, Innovation
from fourbar_ros.estimation.estimator import Estimator, STATE_NAMES
from fourbar_ros.estimation.settings import EstimatorSettings

__all__ = ['Decision', 'DECISIONS', 'Estimate', 'Estimator', 'EstimatorSettings', 'Innovation',
           'STATE_NAMES']
