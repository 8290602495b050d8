# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Mechanism files as text, with what was calibrated and when."""

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
    'link_angle_offsets': 'rad, what the sensors read beyond the truth',
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
    Write all keys of a mechanism, numbers to the last bit.

    :param notes: what was calibrated, one line each, the oldest first.
    """
    lines = [f'{NOTE}{note}' for note in notes]
    for key, meaning in KEYS.items():
        rows = np.asarray(getattr(mechanism, key)).tolist()
        lines.append(f'{key}: {_text(rows)}  # {meaning}')
    return '\n'.join(lines) + '\n'


def notes_of(path: Path) -> list[str]:
    """Return what a mechanism file says of earlier calibrations."""
    return [line[len(NOTE):] for line in path.read_text(encoding='utf-8').splitlines()
            if line.startswith(NOTE)]


def _text(value: object) -> str:
    if isinstance(value, list):
        return f'[{", ".join(map(_text, value))}]'
    # As YAML 1.1 has it: infinity with a point, and no exponent without one.
    text = repr(value)
    if 'inf' in text:
        return text.replace('inf', '.inf')
    mantissa, mark, exponent = text.partition('e')
    return f'{mantissa}{"" if "." in mantissa or not mark else ".0"}{mark}{exponent}'
