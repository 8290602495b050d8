# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Checksum of the prototype's frames: CRC-8 of SAE J1850 over identifier and data.

Polynomial 0x1D, initial value 0xFF, inverted. The identifier is part of it, so that a frame with a
corrupted identifier is not accepted as another message.
"""

from __future__ import annotations

_POLYNOMIAL, _INITIAL, _FINAL_XOR = 0x1D, 0xFF, 0xFF


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = byte << 1 ^ (_POLYNOMIAL | 0x100 if byte & 0x80 else 0)
    return byte


_TABLE = tuple(map(_remainder, range(256)))


def checksum(frame_id: int, data: bytes) -> int:
    """
    Return the checksum of a frame.

    :param frame_id: 11 bits; it counts as two bytes, the high one first.
    :param data: the bytes before the checksum.
    """
    register = _TABLE[_TABLE[_INITIAL ^ frame_id >> 8] ^ frame_id & 0xFF]
    for byte in data:
        register = _TABLE[register ^ byte]
    return register ^ _FINAL_XOR
