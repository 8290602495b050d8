# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The study of the bus in two seconds."""

from fourbar_ros.studies import bus
import pytest

pytestmark = pytest.mark.node


@pytest.mark.slow
def test_nothing_is_lost_in_two_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The round trips depend on the machine and have no limit here."""
    monkeypatch.setattr(bus, 'ANSWER_TIMEOUT_S', 0.1)     # the largest that is allowed
    result = bus.run(lambda items, _: items, seconds=2)
    assert result.data['ticks'] == 500
    # There are twelve frames a tick, heartbeats and clocks; one sample in a hundred is lost.
    assert result.data['frames_received'] > 0.97 * 12 * 500
    assert result.data['frames_sent'] == 5 * 500 + 1
    for kind in ('lost_angles', 'lost_heartbeats', 'replayed', 'wrong_time',
                 'commands_lost_commands', 'commands_replayed', 'lost_answers'):
        assert result.data[kind] == 0, kind
    assert 0.0 < result.data['round_trip_p50_ms'] < result.data['round_trip_max_ms']
    assert result.files['bus.png'].startswith(b'\x89PNG')
