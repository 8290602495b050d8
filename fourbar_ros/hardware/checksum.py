# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The checksum of the prototype's frames: CRC-8 of SAE J1850 over identifier and data.

Polynomial 0x1D, starting with 0xFF, and inverted. With the identifier in it, a frame under a wrong
one is not taken for another message.
"""

from __future__ import annotations

_POLYNOMIAL, _START, _FINAL = 0x1D, 0xFF, 0xFF


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = byte << 1 ^ (_POLYNOMIAL | 0x100 if byte & 0x80 else 0)
    return byte


_TABLE = tuple(map(_remainder, range(256)))


def begun(frame_id: int) -> int:
    """Return the register after the identifier, which counts as two bytes, the high one first."""
    return _TABLE[_TABLE[_START ^ frame_id >> 8] ^ frame_id & 0xFF]


def finished(register: int, data: bytes) -> int:
    """
    Return the checksum.

    :param register: of `begun`.
    :param data: what follows the identifier.
    """
    for byte in data:
        register = _TABLE[register ^ byte]
    return register ^ _FINAL


def checksum(frame_id: int, data: bytes) -> int:
    """
    Return the checksum of a frame.

    :param frame_id: 11 bits.
    :param data: the bytes before the checksum.
    """
    return finished(begun(frame_id), data)
