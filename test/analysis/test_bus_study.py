# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The study of the bus, for two seconds."""

from fourbar_ros.analysis.studies import bus
import pytest

pytestmark = pytest.mark.node


def test_nothing_is_lost_in_two_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever it takes: how long that is depends on the machine, and is what the study tells."""
    monkeypatch.setattr(bus, 'ANSWER_TIMEOUT_S', 5.0)
    result = bus.run(lambda items, _: items, seconds=2)
    assert result.data['ticks'] == 500
    # Heartbeats and clocks come beside twelve frames a tick; a sample in a hundred is left out.
    assert result.data['frames_received'] > 0.97 * 12 * 500
    assert result.data['frames_sent'] == 5 * 500 + 1
    for kind in ('lost_angles', 'lost_heartbeats', 'replayed', 'wrong_time',
                 'commands_lost_commands', 'commands_replayed', 'lost_answers'):
        assert result.data[kind] == 0, kind
    assert 0.0 < result.data['round_trip_p50_ms'] < result.data['round_trip_max_ms']
    assert result.files['bus.png'].startswith(b'\x89PNG')
