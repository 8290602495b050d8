# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""State estimation: extended Kalman filter of the links, with detection of sensor faults."""

from fourbar_ros.estimation.estimate import Estimate, Innovation, SAMPLE_STATUSES, SampleStatus
from fourbar_ros.estimation.estimator import Estimator, STATE_NAMES
from fourbar_ros.estimation.estimator_settings import EstimatorSettings

__all__ = ['Estimate', 'Estimator', 'EstimatorSettings', 'Innovation', 'SAMPLE_STATUSES',
           'SampleStatus', 'STATE_NAMES']
