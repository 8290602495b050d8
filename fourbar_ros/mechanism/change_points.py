# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The tolerances that apply near change points, of all rooms, in one table.

At a change point all links lie on one line and two branches of the closure meet. One of the two
directions of the closure constraint, the *weak* one, vanishes there. `|sin(phi_d - phi_c)|`
measures the distance on any linkage: it is the alignment of links c and d, and the reduced form
does not exist where it vanishes. The ratio of the singular values of the constraint, weak over
strong, measures it without a choice of links (docs/mechanics.md, change points).

The table is ordered from the largest distance to the smallest.
"""

from __future__ import annotations

from math import radians

# Ratio of singular values above which a loop with compliant joints counts as rigid in the weak
# direction, too. A parallelogram with `|sin|` below `REDUCED_FORM_LIMIT` stays below it; the
# folded branch, where the links have leverage, is above it.
RIGID_CONSTRAINT_RATIO = 0.4

# `|sin theta|` between the pairs from which on the controller does not hold the branch. Above
# `REDUCED_FORM_LIMIT`: there the closure holds the branch by itself.
HOLD_FADES_TO = 0.35

# Smallest `|sin(phi_d - phi_c)|` at which the reduced form is integrated. It loses about 1 /
# |sin|^2 in accuracy, here one digit. The constrained form takes over, at several times the cost.
REDUCED_FORM_LIMIT = 0.3

# Smallest angle between links c and d in a calibration run [rad]: `|sin|` of 0.17, where an
# encoder error enters the dependent angles six times larger.
EXCITATION_CLEARANCE = radians(10.0)

# `|sin theta|` between the pairs up to which the controller holds the branch in full. Above
# `PLANNING_MARGIN`: the hold is full on every move that meets a change point.
HOLD_FADES_FROM = 0.15

# Smallest `|sin(phi_d - phi_c)|` on a planned move: there the wheels begin to lose their authority
# over the configuration, and a margin is left to `TORQUE_CUTOFF` for tracking errors.
PLANNING_MARGIN = 0.1

# Largest correction of a measured link angle by which a first estimate near alignment is brought
# onto the closure [rad]: 57 times a sensor error of 0.1 deg, and less than the distance of another
# branch at `REDUCED_FORM_LIMIT`.
ASSEMBLY_DISTANCE = 0.1

# `|sin(phi_d - phi_c)|` below which a linkage without paired links gets no torque. Half of
# `PLANNING_MARGIN`; Gamma amplifies errors of the angles by 20 here.
TORQUE_CUTOFF = 0.05

# Largest deviation of the second link of a pair from its place on a branch [rad]: six times a
# sensor error of 0.1 deg. Another branch comes as close only where the two meet.
BRANCH_TOLERANCE = 0.01

# Angle between the pairs within which a resting reference is at a change point [rad]: above what
# rounding and a soft step leave of a goal, below what a sensor resolves.
IN_LINE_ANGLE = 1e-3

# Ratio of singular values below which the third derivative of the closure gives the acceleration
# along the weak direction. There removing a closure error would divide the rounding of an angle by
# this ratio, so the error stays. Lengths that differ by less than the square, 1e-8 of the length,
# count as equal (`MATCHING_LENGTHS`).
WEAK_CONSTRAINT_RATIO = 1e-4

# Sine of the angle within which two links count as lying on each other, to name the branch.
FOLDED_SINE = 1e-6

# Mismatch of lengths at a change point, relative to their mean, that is removed when a mechanism
# is made: `WEAK_CONSTRAINT_RATIO` squared. No linkage is made so precisely, and double precision
# resolves neither a passage nor a fold below it.
MATCHING_LENGTHS = 1e-8

# Ratio of singular values below which nothing constrains the weak direction: rounding of the
# angles times the condition of the mass matrix. A linkage at rest may leave on either branch.
FREE_CONSTRAINT_RATIO = 1e-9

# `|sin(phi_d - phi_c)|` at which the rates of links a and b do not determine those of c and d.
RATES_UNDETERMINED = 1e-9

# Difference of lengths, relative to their mean, below which links can turn in pairs. Less than
# `MATCHING_LENGTHS`, since matched lengths are equal to rounding.
EQUAL_LENGTHS = 1e-9

# Mismatch of lengths, relative to their mean, that the sum of the lengths rounds off.
LENGTH_ROUNDING = 1e-15

# Longest time constant of the passage through a change point [s]. The third derivative is weighted
# by the time that the motion takes through `WEAK_CONSTRAINT_RATIO`; at rest that would be
# infinite.
LONGEST_PASSAGE = 1.0

# Square of the weak singular value over its variance from which the estimator holds the weak
# direction: three standard deviations away from a change point.
DISTINCT_SIGMAS_SQUARED = 9.0
