# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Names of all topics and services (docs/topics.md).

Names without a leading slash are relative: ROS puts the namespace of the node in front.
"""

# Device, topics.
LINK_ANGLES = 'link_angles'
FLYWHEEL_STATES = 'flywheel_states'
FLYWHEEL_COMMAND = 'flywheel_command'
DEVICE_STATUS = 'device_status'
TIMING = 'timing'
EMERGENCY_STOP_REQUEST = 'emergency_stop_request'
# Device, services.
ARM = 'arm'
EMERGENCY_STOP = 'emergency_stop'
RESET_EMERGENCY_STOP = 'reset_emergency_stop'

# Simulation, topics.
SIM_LINK_STATES = 'sim/link_states'
SIM_FLYWHEEL_STATES = 'sim/flywheel_states'
SIM_ODOMETRY = 'sim/odometry'
SIM_LEDGER = 'sim/ledger'
# Simulation, services.
SIM_PAUSE = 'sim/pause'
SIM_STEP = 'sim/step'
SIM_RESET = 'sim/reset'

# Estimator, topics.
ESTIMATE_LINK_STATES = 'estimate/link_states'
ESTIMATE_SIGMA = 'estimate/sigma'
ESTIMATE_COVARIANCE = 'estimate/covariance'
ESTIMATE_DISTURBANCE = 'estimate/disturbance'
ESTIMATE_GYRO_BIAS = 'estimate/gyro_bias'
ESTIMATE_DECISIONS = 'estimate/decisions'
ESTIMATE_INNOVATION = 'estimate/innovation'
# Header; answers a tick for which there is no estimate.
ESTIMATE_WAITING = 'estimate/waiting'
# Estimator, service.
ESTIMATE_RESET = 'estimate/reset'

# Controller, topics.
SETPOINT = 'setpoint'
TRAJECTORY = 'trajectory'
REFERENCE = 'reference'
TRACKING_ERROR = 'tracking_error'
ENERGY = 'energy'
ALLOCATION = 'allocation'
MOMENTUM = 'momentum'
CONTROLLER_STATUS = 'controller_status'
# Controller, services.
ENABLE = 'enable'
HOLD = 'hold'
DAMP = 'damp'

# All nodes, topics.
DIAGNOSTICS = '/diagnostics'
CLOCK = '/clock'
