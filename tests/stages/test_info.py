"""The overview of `dmrl info`."""

from pathlib import Path

import pytest

from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read_summary
from dmrl.recording.overview import topic_rows


def test_rate_of_a_topic_uses_its_own_time_span(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(2000):
            sink.write(k * 10_000_000, "/cf1/height", message_class("Height")())
            if k >= 1000:  # also 100 Hz, but only from 10 s on
                sink.write(k * 10_000_000, "/cf2/height", message_class("Height")())
        sink.write(0, "/cf3/height", message_class("Height")())
    rates = {topic: rate for topic, *_, rate in topic_rows(path, read_summary(path))}
    assert rates.pop("/cf3/height") is None
    assert rates == pytest.approx({"/cf1/height": 100.0, "/cf2/height": 100.0})
