# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Write mechanism files, with notes on the calibrations behind their values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fourbar_ros.mechanism import Mechanism
import numpy as np

NOTE = '# Calibrated: '
KEYS = {
    'link_lengths': 'm, joint to joint',
    'link_masses': 'kg, flywheel included',
    'link_inertias': "kg m^2, about the mass centre, without the wheel's axial inertia",
    'com_positions': "m, in the link's frame",
    'link_angle_offsets': 'rad, encoder reading minus true angle',
    'flywheel_inertias': 'kg m^2, axial',
    'motor_torque_limits': 'N m',
    'motor_speed_limits': 'rad/s, relative to the link',
    'motor_time_constants': 's',
    'motor_torque_constants': 'N m/A',
    'motor_resistances': 'ohm',
    'motor_voltages': 'V',
    'joint_stiffness': 'N/m',
    'joint_damping': 'N s/m',
}


def mechanism_text(mechanism: Mechanism, notes: Sequence[str]) -> str:
    """
    Return a mechanism file with all keys; numbers keep every bit.

    :param notes: one line for each calibration, the oldest first.
    """
    lines = [f'{NOTE}{note}' for note in notes]
    lines += [f'{key}: {_text(np.asarray(getattr(mechanism, key)).tolist())}  # {meaning}'
              for key, meaning in KEYS.items()]
    return '\n'.join(lines) + '\n'


def calibration_notes(path: Path) -> list[str]:
    """Return the notes of earlier calibrations in a mechanism file."""
    return [line[len(NOTE):] for line in path.read_text(encoding='utf-8').splitlines()
            if line.startswith(NOTE)]


def yaml_number(text: str) -> str:
    """Return a number as YAML 1.1 reads it: `.inf`, and with a decimal point."""
    if 'inf' in text:
        return text.replace('inf', '.inf')
    mantissa, mark, exponent = text.partition('e')
    return f'{mantissa}{"" if "." in mantissa else ".0"}{mark}{exponent}'


def _text(value: object) -> str:
    if isinstance(value, list):
        return f'[{", ".join(map(_text, value))}]'
    return yaml_number(repr(value))
