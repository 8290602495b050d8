# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluation of a bag for each kind of calibration: estimates, text, checks and figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from fourbar_ros.analysis.bag_reader import bag_error
from fourbar_ros.analysis.bags import Bag
from fourbar_ros.analysis.calibration.encoder_offsets import (
    encoder_offsets,
    jig_pose,
    MAX_DEVIATION,
    mean_readings,
)
from fourbar_ros.analysis.calibration.link_identification import link_estimate, LinkEstimate
from fourbar_ros.analysis.calibration.measurements import read_links, read_measurements
from fourbar_ros.analysis.calibration.mechanism_file import yaml_number
from fourbar_ros.analysis.calibration.parameter_estimates import (
    as_json,
    as_table,
    CalibrationError,
    ParameterEstimate,
    QUANTILE_95,
)
from fourbar_ros.analysis.calibration.wheel_identification import (
    driven_wheels,
    mean_friction,
    wheel_estimate,
)
from fourbar_ros.common.checks import at_most, Check
from fourbar_ros.common.names import DEVICE_STATUS
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, Mechanism
import numpy as np

# Largest half width of a 95 % interval, over the value.
PRECISION = 0.01
# Largest half width of the interval of an offset [rad]: a tenth of the noise of good sensors.
OFFSET_PRECISION = 5e-4
# Offset that suggests a wrong pose [rad].
LARGE_OFFSET = np.radians(20.0)
# Largest residual ratio of links without an external disturbance [1].
MAX_RESIDUAL_RATIO = 1.5


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """
    Result of one calibration.

    :param mechanism: with the estimates.
    :param note: names of the estimated keys, for the mechanism file.
    :param text: for the terminal, several lines.
    :param checks: whether the intervals are narrow enough.
    :param data: for a JSON file, beside the checks.
    :param report: for a YAML report; empty without one.
    :param figure: draws it; None without one. Requires matplotlib.
    """

    mechanism: Mechanism
    note: str
    text: str
    checks: Sequence[Check]
    data: Mapping[str, Any]
    report: Mapping[str, Any] = field(default_factory=dict)
    figure: Callable[[], Any] | None = None


def recorded_mechanism(bag: Bag) -> str:
    """
    Return the name of the mechanism in the device status.

    :raises BagError: the bag has none.
    """
    if name := bag.last_status(DEVICE_STATUS, 'mechanism'):
        return name
    raise bag_error(bag.path, 'no_data', ': no device_status that names a mechanism: give '
                    '--mechanism', topic=DEVICE_STATUS)


def calibrate_encoders(bag: Bag, mechanism: Mechanism, known: Mapping[str, float]
                       ) -> CalibrationResult:
    """
    Estimate the offsets of the link encoders.

    :param known: pose of the jig, orientation by link [rad].
    :raises FourbarError: the bag lacks data, the pose does not close, or a link is not at rest.
    """
    links = read_links(bag)
    pose = jig_pose(mechanism, known, mean_readings(links))
    result = encoder_offsets(links, pose)
    estimates = result.estimates(mechanism.link_angle_offsets)
    lines = [as_table(estimates), 'peak to peak [rad]: ' + ', '.join(
        f'{name} {size:.2g}' for name, size in zip(LINK_NAMES, result.peak_to_peak))]
    checks = []
    for link, name in enumerate(LINK_NAMES):
        if abs(result.offsets[link]) > LARGE_OFFSET:
            lines.append(f'{name}: the offset of {np.degrees(result.offsets[link]):.1f} deg is '
                         'large, check the pose')
        checks += [
            at_most(f'zero of {name}, half of the interval', estimates[link].half_width, 'rad',
                    OFFSET_PRECISION),
            at_most(f'readings of {name}, half of peak to peak',
                    0.5 * float(result.peak_to_peak[link]), 'rad', 4.0 * MAX_DEVIATION)]
    return CalibrationResult(
        replace(mechanism, link_angle_offsets=np.array([item.value for item in estimates])),
        'link_angle_offsets', '\n'.join(lines), checks, {
            'quantities': as_json(estimates), 'pose_rad': result.pose.tolist(),
            'peak_to_peak_rad': result.peak_to_peak.tolist(),
            'samples': [int(count) for count in result.counts]})


def calibrate_wheels(bag: Bag, mechanism: Mechanism, selected: Sequence[int] | None = None
                     ) -> CalibrationResult:
    """
    Estimate inertia and bearing friction of the wheels.

    :param selected: indices of the wheels, by default all that were driven.
    :raises FourbarError: the bag lacks data, or no spin-up with a coast-down.
    """
    links, wheels = read_measurements(bag)
    indices = driven_wheels(wheels) if selected is None else list(selected)
    if not indices:
        raise CalibrationError(f'{bag.path}: no wheel was driven to a sufficient speed',
                               reason='excitation')
    results = [wheel_estimate(wheel, links, wheels) for wheel in indices]
    names = [FLYWHEEL_NAMES[wheel] for wheel in indices]
    estimates = [result.estimates(mechanism) for result in results]
    friction = mean_friction(results)
    quantities = [item for of_wheel in estimates for item in of_wheel]
    inertias = mechanism.flywheel_inertias.copy()
    checks = []
    for name, result, (inertia, *_) in zip(names, results, estimates):
        inertias[result.wheel] = result.inertia
        top = max(float(np.abs(segment.speeds).max()) for segment in result.segments)
        # Friction at the highest speed: its viscous part is negligible at low speeds.
        gradient = np.array([0.0, 1.0, top])
        checks += [
            at_most(f'{name} inertia, half of the interval',
                    inertia.half_width / result.inertia, '', PRECISION),
            at_most(f'{name} friction at {top:.0f} rad/s, half of the interval', float(
                QUANTILE_95 * np.sqrt(gradient @ result.covariance @ gradient)
                / (result.coulomb + result.viscous * top)), '', PRECISION)]
    lines = [as_table([*quantities, *friction]), '',
             'parameters of the controller, for the parameters file:',
             '/**/controller:', '  ros__parameters:',
             *(f'    {item.name}: {yaml_number(f"{item.value:.6g}")}  # [{item.unit}]'
               for item in friction)]
    report = {
        'wheels': {name: {
            item.name.rpartition(' ')[2]: {
                'value': item.value, 'interval_95': list(item.interval), 'unit': item.unit}
            for item in of_wheel} for name, of_wheel in zip(names, estimates)},
        'controller': {item.name: item.value for item in friction}}

    def draw() -> Any:
        from fourbar_ros.analysis.calibration.calibration_figures import wheels_figure
        return wheels_figure(results)
    return CalibrationResult(
        replace(mechanism, flywheel_inertias=inertias), f'flywheel_inertias of {", ".join(names)}',
        '\n'.join(lines), checks, {'quantities': as_json([*quantities, *friction])}, report, draw)


def calibrate_links(bag: Bag, mechanism: Mechanism) -> CalibrationResult:
    """
    Estimate inertias and mass centres of the links.

    :raises FourbarError: the bag lacks data, or the motion determines no parameter.
    """
    links, wheels = read_measurements(bag)
    result = link_estimate(mechanism, links, wheels)
    parameters, reduced = result.parameters(), result.reduced_inertias()
    checks = []
    for aa, ab, bb in zip(reduced[0::3], reduced[1::3], reduced[2::3]):
        size = float(np.sqrt(aa.value * bb.value))
        checks += [at_most(f'{item.name}, half of the interval', item.half_width / size, '',
                           PRECISION) for item in (aa, ab, bb)]

    def draw() -> Any:
        from fourbar_ros.analysis.calibration.calibration_figures import links_figure
        return links_figure(result)
    calibrated = replace(mechanism, link_inertias=result.mechanism.link_inertias,
                         com_positions=result.mechanism.com_positions)
    return CalibrationResult(
        calibrated, 'link_inertias and com_positions (determined combinations)',
        links_text(result, parameters, reduced), checks, {
            'quantities': as_json(parameters), 'reduced_inertias': as_json(reduced),
            'combinations': [{
                'text': item.text, 'weights': item.weights.tolist(),
                'determined': item.determined, 'standard_error_in_priors': item.error,
                'change_in_priors': item.change} for item in result.combinations],
            'losses': vars(result.losses), 'residual_rms_rad': result.noise,
            'residual_over_noise': result.residual_ratio}, {}, draw)


def links_text(result: LinkEstimate, parameters: Sequence[ParameterEstimate],
               reduced: Sequence[ParameterEstimate]) -> str:
    """Return the text of a calibration of the links."""
    determined = [item for item in result.combinations if item.determined]
    others = [item for item in result.combinations if not item.determined]
    lines = ['mass matrix of the reduced form:', as_table(reduced), '',
             f'determined combinations: {len(determined)} of {len(parameters)} '
             '(in units of 10 % of each parameter, ± 95 %):']
    lines += [f'  {item.change:+.4f} ± {QUANTILE_95 * item.error:.4f}  {item.text}'
              for item in determined]
    if others:
        lines += ['not determined, kept as close as possible to the values before:',
                  *(f'  {item.text}' for item in others)]
    lines += ['', 'for the mechanism file (an interval without information is the 10 % prior):',
              as_table(parameters), f'residuals {np.degrees(result.noise):.3g} deg rms']
    if result.residual_ratio > MAX_RESIDUAL_RATIO:
        lines.append(
            f'the residuals are {result.residual_ratio:.2g} times white noise (limit '
            f'{MAX_RESIDUAL_RATIO:g}): a disturbance moved the links (edge of the table, a hand, '
            'a cable); discard these values')
    return '\n'.join(lines)
