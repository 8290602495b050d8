# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The examples of docs/extending.md that are whole modules run as they stand."""

from math import inf, tau
from pathlib import Path
import re
import struct
from typing import Any

from fourbar_ros.common.progress import no_progress
from fourbar_ros.hardware.messages import Frame, FrameError, WheelReport
import pytest

PAGE = Path(__file__).parents[1] / 'docs' / 'extending.md'


def example(path: str) -> dict[str, Any]:
    """Run the example that is headed by a path, and return its names."""
    blocks = re.findall(r'```python\n(.*?)```', PAGE.read_text(), re.DOTALL)
    code, = (block for block in blocks if block.startswith(f'# {path}\n'))
    names: dict[str, Any] = {}
    exec(compile(code, path, 'exec'), names)
    return names


def test_codec_returns_the_report_that_it_encoded() -> None:
    codec = example('hardware/plain_codec.py')['PlainCodec']()
    report = WheelReport(2, None, 1.5, tau, None, 0, 0.25)
    frame, = codec.to_host(report)
    assert codec.from_links(frame) == report
    assert codec.from_links(Frame(0x105, frame.data)) is None


@pytest.mark.parametrize(('data', 'kind'), [
    (b'123', 'length'), (struct.pack('<ff', inf, 1.0), 'value')])
def test_codec_refuses_a_bad_frame(data: bytes, kind: str) -> None:
    codec = example('hardware/plain_codec.py')['PlainCodec']()
    with pytest.raises(FrameError) as caught:
        codec.from_links(Frame(0x101, data))
    assert caught.value.kind == kind


@pytest.mark.medium
def test_study_gives_the_turns_of_four_wheels() -> None:
    result = example('studies/turns.py')['run'](no_progress)
    assert len(result.data['turns']) == 4
    assert all(check.passed for check in result.checks)
