"""Message counts against the statistics record."""

from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest
from mcap.exceptions import McapError

from dmrl.recording.mcap.message_count import check_counts


def build_statistics(counts: dict[int, int] | None) -> Any:
    """Build statistics with these message counts by channel, or None without counts."""
    return None if counts is None else SimpleNamespace(channel_message_counts=counts)


CHANNELS: Any = {1: SimpleNamespace(topic="/a"), 2: SimpleNamespace(topic="/b")}


@pytest.mark.parametrize(
    ("said", "found", "fault"),
    [
        ({1: 3, 2: 1}, {1: 3, 2: 1}, ""),
        ({1: 3}, {1: 3}, ""),
        ({1: 3, 2: 1}, {1: 2, 2: 1}, "/a has 2 of 3 messages"),
        ({1: 3, 2: 1}, {1: 3, 2: 2}, "/b has 2 of 1 messages"),
        ({1: 3, 2: 1}, {1: 3}, "/b has 0 of 1 messages"),
        ({1: 3}, {1: 3, 2: 1}, "/b has 1 of 0 messages"),
        (None, {1: 3}, ""),
        ({}, {1: 3}, ""),
    ],
)
def test_message_count_must_match_statistics(
    said: dict[int, int] | None, found: dict[int, int], fault: str
) -> None:
    if not fault:
        check_counts(build_statistics(said), CHANNELS, Counter(found))
        return
    with pytest.raises(McapError, match=fault):
        check_counts(build_statistics(said), CHANNELS, Counter(found))
