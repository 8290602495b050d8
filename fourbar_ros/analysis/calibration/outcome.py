# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A bag in, and everything that a calibration has to say out: numbers, text, checks, picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from fourbar_ros.analysis.bags import BagError, Recording
from fourbar_ros.analysis.calibration.encoders import (
    encoder_offsets,
    jig_pose,
    LARGEST_SPREAD,
    mean_readings,
)
from fourbar_ros.analysis.calibration.links import link_estimate, LinkEstimate
from fourbar_ros.analysis.calibration.quantity import (
    as_json,
    as_table,
    CalibrationError,
    Quantity,
    WIDTH_95,
)
from fourbar_ros.analysis.calibration.signals import links_in, signals_in
from fourbar_ros.analysis.calibration.wheels import (
    friction_of_all,
    wheel_estimate,
    wheels_moved,
)
from fourbar_ros.common import names
from fourbar_ros.common.checks import at_most, Check
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, Mechanism
import numpy as np

# Half of a 95 % interval over its value may be so large at most.
PRECISION = 0.01
# So well should a zero be known: a tenth of the noise of a good sensor [rad].
ZERO_PRECISION = 5e-4
# How many times their noise the residuals of the links may be.
MOST_EXCESS = 1.5


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    What one calibration found.

    :param mechanism: with what was calibrated.
    :param note: what that is, for the mechanism file.
    :param quantities: what goes into files.
    :param text: for people, several lines.
    :param checks: whether the intervals are narrow enough.
    :param data: plain, for a JSON file, beside the checks.
    :param report: plain, for a report in YAML; empty where there is none.
    :param figure: draws it, None where there is nothing to draw; needs matplotlib.
    """

    mechanism: Mechanism
    note: str
    quantities: Sequence[Quantity]
    text: str
    checks: Sequence[Check]
    data: Mapping[str, Any]
    report: Mapping[str, Any] = field(default_factory=dict)
    figure: Callable[[], Any] | None = None


def mechanism_name_in(recording: Recording) -> str:
    """
    Return the mechanism that the device named.

    :raises BagError: it did not.
    """
    if recording.has(names.DEVICE_STATUS):
        for status in reversed(recording.statuses(names.DEVICE_STATUS)):
            if name := status.values.get('mechanism'):
                return name
    raise BagError(f'{recording.path}: no device_status that names a mechanism: give --mechanism')


def encoders_outcome(recording: Recording, mechanism: Mechanism, known: Mapping[str, float]
                     ) -> Outcome:
    """
    Find the zeros of the link encoders.

    :param known: pose of the jig, orientation by link [rad].
    :raises FourbarError: the bag lacks data, the pose does not close, or a link does not rest.
    """
    links = links_in(recording)
    pose = jig_pose(mechanism, known, mean_readings(links))
    found = encoder_offsets(links, pose)
    quantities = found.quantities(mechanism.link_angle_offsets)
    far = [f'{name} reads {np.degrees(offset):.1f} deg beyond the pose'
           for name, offset in zip(LINK_NAMES, found.offsets) if abs(offset) > np.radians(20.0)]
    lines = [as_table(quantities), 'peak to peak [rad]: ' + ', '.join(
        f'{name} {size:.2g}' for name, size in zip(LINK_NAMES, found.peak_to_peak)),
        *(f'{text}: is the pose right?' for text in far)]
    checks = [check for link, name in enumerate(LINK_NAMES) for check in (
        at_most(f'zero of {name}, half of the interval',
                WIDTH_95 * float(found.standard_errors[link]), 'rad', ZERO_PRECISION),
        at_most(f'readings of {name}, half of peak to peak',
                0.5 * float(found.peak_to_peak[link]), 'rad', 4.0 * LARGEST_SPREAD))]
    offsets = np.array([item.value for item in quantities])
    return Outcome(
        replace(mechanism, link_angle_offsets=offsets), 'link_angle_offsets', quantities,
        '\n'.join(lines), checks, {
            'quantities': as_json(quantities), 'pose_rad': found.pose.tolist(),
            'peak_to_peak_rad': found.peak_to_peak.tolist(),
            'samples': [int(count) for count in found.counts]})


def wheels_outcome(recording: Recording, mechanism: Mechanism, chosen: Sequence[int] | None = None
                   ) -> Outcome:
    """
    Find inertia and bearing friction of the wheels.

    :param chosen: indices of the wheels, by default all that were driven.
    :raises FourbarError: the bag lacks data, or no wheel was spun up and let coast.
    """
    links, wheels = signals_in(recording)
    moved = wheels_moved(wheels) if chosen is None else list(chosen)
    if not moved:
        raise CalibrationError(f'{recording.path}: no wheel was driven and turned fast')
    estimates = [wheel_estimate(wheel, links, wheels) for wheel in moved]
    quantities = [item for one in estimates for item in one.quantities(mechanism)]
    friction = friction_of_all(estimates)
    inertias = mechanism.flywheel_inertias.copy()
    checks = []
    for one in estimates:
        inertias[one.wheel] = one.inertia
        name, errors = FLYWHEEL_NAMES[one.wheel], np.sqrt(np.diag(one.covariance))
        top = max(float(np.abs(piece.speeds).max()) for piece in one.pieces)
        # Of the friction at the highest speed: there is little that is viscous at lower ones.
        slope = np.array([0.0, 1.0, top])
        checks += [
            at_most(f'{name} inertia, half of the interval', float(
                WIDTH_95 * errors[0] / one.inertia), '', PRECISION),
            at_most(f'{name} friction at {top:.0f} rad/s, half of the interval', float(
                WIDTH_95 * np.sqrt(slope @ one.covariance @ slope)
                / (one.coulomb + one.viscous * top)), '', PRECISION)]
    lines = [as_table([*quantities, *friction]), '',
             'parameters of the controller, for the parameters file:',
             '/**/controller:', '  ros__parameters:',
             *(f'    {item.name}: {_number(item.value)}  # [{item.unit}]' for item in friction)]
    note = f'flywheel_inertias of {", ".join(FLYWHEEL_NAMES[one.wheel] for one in estimates)}'
    report = {
        'wheels': {FLYWHEEL_NAMES[one.wheel]: {
            item.name.rpartition(' ')[2]: {
                'value': item.value, 'interval_95': list(item.interval), 'unit': item.unit}
            for item in one.quantities(mechanism)} for one in estimates},
        'controller': {item.name: item.value for item in friction}}

    def draw() -> Any:
        from fourbar_ros.analysis.calibration.figure import wheels_figure
        return wheels_figure(estimates)
    return Outcome(
        replace(mechanism, flywheel_inertias=inertias), note, quantities, '\n'.join(lines),
        checks, {'quantities': as_json([*quantities, *friction])}, report, draw)


def links_outcome(recording: Recording, mechanism: Mechanism) -> Outcome:
    """
    Find inertias and mass centres of the links.

    :raises FourbarError: the bag lacks data, or the motion tells nothing.
    """
    links, wheels = signals_in(recording)
    found = link_estimate(mechanism, links, wheels)
    parameters, reduced = found.parameters(), found.reduced_inertias()
    checks = []
    for aa, ab, bb in zip(reduced[0::3], reduced[1::3], reduced[2::3]):
        size = float(np.sqrt(aa.value * bb.value))
        checks += [at_most(f'{item.name}, half of the interval', WIDTH_95 * item.standard_error
                           / size, '', PRECISION) for item in (aa, ab, bb)]

    def draw() -> Any:
        from fourbar_ros.analysis.calibration.figure import links_figure
        return links_figure(found)
    after = replace(mechanism, link_inertias=found.mechanism.link_inertias,
                    com_positions=found.mechanism.com_positions)
    return Outcome(
        after, 'link_inertias and com_positions, as far as the motion tells', parameters,
        _links_text(found, parameters, reduced), checks, {
            'quantities': as_json(parameters), 'reduced_inertias': as_json(reduced),
            'combinations': [{
                'text': one.text, 'weights': one.weights.tolist(), 'determined': one.determined,
                'standard_error_in_priors': one.error, 'change_in_priors': one.change}
                for one in found.combinations],
            'losses': vars(found.losses), 'residual_rms_rad': found.noise,
            'residual_over_noise': found.excess}, {}, draw)


def _links_text(found: LinkEstimate, parameters: Sequence[Quantity],
                reduced: Sequence[Quantity]) -> str:
    determined = [one for one in found.combinations if one.determined]
    others = [one for one in found.combinations if not one.determined]
    lines = ['what the motion depends on (mass matrix of the reduced form):', as_table(reduced),
             '', f'determined are {len(determined)} combinations of the {len(parameters)} '
             'parameters (in shares of 10 % of each, ± 95 %):']
    lines += [f'  {one.change:+.4f} ± {WIDTH_95 * one.error:.4f}  {one.text}'
              for one in determined]
    if others:
        lines += ['not determined, left as near as can be to what they were:',
                  *(f'  {one.text}' for one in others)]
    lines += ['', 'for the mechanism file (intervals rest on 10 % where the data do not tell):',
              as_table(parameters), f'residuals {np.degrees(found.noise):.3g} deg rms']
    if found.excess > MOST_EXCESS:
        lines.append(
            f'these are {found.excess:.2g} times the noise, at most {MOST_EXCESS:g} is usual: '
            'something else moved the links (the edge of the table, a hand, a cable); do not '
            'take these values')
    return '\n'.join(lines)


def _number(value: float) -> str:
    text = f'{value:.6g}'
    mantissa, mark, exponent = text.partition('e')
    return f'{mantissa}{"" if "." in mantissa else ".0"}{mark}{exponent}'
