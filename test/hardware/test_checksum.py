# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The checksum of frames is CRC-8 SAE J1850 over identifier and data."""

from crccheck.crc import Crc8SaeJ1850
from fourbar_ros.hardware.checksum import checksum
import numpy as np
import pytest


def test_check_value_of_the_catalogue():
    """The text is `123456789`; its first two bytes are the identifier."""
    assert checksum(0x3132, b'3456789') == 0x4B


@pytest.mark.parametrize('seed', range(3))
def test_agrees_with_another_implementation(seed):
    rng = np.random.default_rng(seed)
    for length in range(8):
        for frame_id in rng.integers(0, 0x800, 20):
            data = rng.bytes(length)
            expected = Crc8SaeJ1850.calc(int(frame_id).to_bytes(2, 'big') + data)
            assert checksum(int(frame_id), data) == expected, f'seed {seed}'


def test_checksum_depends_on_the_identifier():
    """Identifiers that differ in up to 8 adjacent bits have different checksums."""
    data = bytes(range(7))
    for bits in range(1, 256):
        for shift in range(11):
            other = 0x2A5 ^ bits << shift & 0x7FF
            assert other == 0x2A5 or checksum(other, data) != checksum(0x2A5, data)
