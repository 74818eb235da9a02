"""Contradictory summaries are refused as damaged."""

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
from mcap.exceptions import McapError

from dmrl.recording.mcap.summary_checks import check_extra_counts, check_statistics


def build_summary(**more: Any) -> Any:
    """Build a summary of two channels with five messages in one chunk; ``more`` overrides it."""
    chunk = SimpleNamespace(message_index_offsets={1: 0, 2: 0})
    channel = SimpleNamespace(topic="/a", schema_id=3)
    statistics = {
        "channel_message_counts": {1: 3, 2: 2},
        "message_count": 5,
        "chunk_count": 1,
        "metadata_count": 0,
        "attachment_count": 0,
    }
    said = {key: value for key, value in more.items() if key in statistics}
    held = {
        "statistics": SimpleNamespace(**statistics | said),
        "chunk_indexes": [chunk],
        "channels": {1: channel, 2: channel},
        "schemas": {3: SimpleNamespace(name="x")},
        "metadata_indexes": [],
        "attachment_indexes": [],
    }
    return SimpleNamespace(**held | {key: more[key] for key in more.keys() - said.keys()})


@pytest.mark.parametrize(
    ("more", "fault"),
    [
        ({}, ""),
        ({"statistics": None}, ""),
        ({"message_count": 6}, "its statistics contradict themselves"),
        ({"message_count": 4}, "its statistics contradict themselves"),
        ({"channel_message_counts": {}, "message_count": 6}, ""),
        ({"chunk_count": 2}, "its summary lists 1 of 2 chunks"),
        ({"metadata_count": 2, "metadata_indexes": [1]}, "it has 1 of 2 metadata records"),
        ({"attachment_count": 0, "attachment_indexes": [1]}, "it has 1 of 0 attachments"),
        ({"metadata_count": 2}, "it has 0 of 2 metadata records"),
        ({"channel_message_counts": {1: 3, 7: 2}}, "its summary lacks channel 7"),
        ({"channel_message_counts": {1: 5, 7: 0}}, ""),
        ({"channels": {1: SimpleNamespace(topic="/a", schema_id=3)}}, "lacks channel 2"),
        ({"schemas": {}}, "its summary lacks the schema of /a"),
    ],
)
def test_contradictory_summary_is_refused(more: dict[str, Any], fault: str) -> None:
    expected = pytest.raises(McapError, match=fault) if fault else nullcontext()
    with expected:
        check_statistics(build_summary(**more))
        check_extra_counts(build_summary(**more))
