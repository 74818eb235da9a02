"""Columns encoded as messages give the bytes of Google's protobuf."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.errors import RecordingError
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read_raw
from dmrl.recording.protobuf.encode import encode

RNG = np.random.default_rng(0)
COUNT = 300
SOME_ZERO = np.where(RNG.random(COUNT) < 0.3, 0.0, RNG.normal(size=COUNT))


def get_row_value(value: Any, k: int) -> Any:
    """Return the value of a column in row ``k``."""
    if isinstance(value, Mapping):
        return {name: get_row_value(column, k) for name, column in value.items()}
    if isinstance(value, str | bytes | int | float):
        return value
    return value[k].tolist() if hasattr(value[k], "tolist") else value[k]


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        ("Attitude", {"roll_rad": SOME_ZERO, "pitch_rad": RNG.normal(size=COUNT), "yaw_rad": -0.0}),
        ("Height", {"height_m": np.array([0.0, -0.0, np.nan, np.inf] * 75)}),
        (
            "PeerPosition",
            {
                "frame_id": "cf1/horizontal",
                "x": SOME_ZERO,
                "covariance": RNG.normal(size=(COUNT, 9)),
                "status": RNG.integers(0, 4, COUNT),
            },
        ),
        ("PeerPosition", {"covariance": np.zeros((COUNT, 0)), "frame_id": ""}),
        ("PeerPosition", {"frame_id": np.array(["", "cf1", "Bär/horizontal"] * 100)}),
        ("GridMap", {"rows": RNG.integers(0, 2**31, COUNT) >> RNG.integers(0, 31, COUNT)}),
        (
            "PoseInFrame",
            {
                "timestamp": {
                    "seconds": RNG.integers(-5, 2**33, COUNT),
                    "nanos": RNG.integers(0, 10**9, COUNT) * (RNG.random(COUNT) < 0.5),
                },
                "pose": {"position": {"x": SOME_ZERO}, "orientation": {}},
            },
        ),
    ],
)
def test_encoded_bytes_equal_google_protobuf(kind: str, fields: dict[str, Any]) -> None:
    made = message_class(kind)
    data, at = encode(made.DESCRIPTOR, fields, COUNT)
    for k in range(COUNT):
        theirs = made(**get_row_value(fields, k)).SerializeToString()
        assert data[at[k] : at[k + 1]].tobytes() == theirs
    assert at[-1] == len(data)


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"height": np.zeros(3)}, ValueError),
        ({"height_m": ["1.0", "2.0", "3.0"]}, TypeError),
        ({"height_m": np.zeros(2)}, ValueError),
        ({"height_m": {"x": np.zeros(3)}}, TypeError),
    ],
)
def test_columns_that_do_not_fit_are_refused(fields: dict[str, Any], error: type) -> None:
    with pytest.raises(error):
        encode(message_class("Height").DESCRIPTOR, fields, 3)


@pytest.mark.parametrize("rows", [[1.5, 2.0], [2**40, 1], [np.nan, 1.0]])
def test_numbers_that_are_not_whole_or_too_large_are_refused(rows: list[float]) -> None:
    with pytest.raises(ValueError, match="integers within its range"):
        encode(message_class("GridMap").DESCRIPTOR, {"rows": rows}, 2)


def test_recording_of_columns_equals_that_of_messages(tmp_path: Path) -> None:
    times = np.sort(RNG.integers(0, 10**12, 9000))
    roll = RNG.normal(size=9000)
    with RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink:
        for time_ns, value in zip(times.tolist(), roll.tolist(), strict=True):
            sink.write(time_ns, "/cf1/attitude", message_class("Attitude")(roll_rad=value))
    with RecordingWriter(tmp_path / "b.mcap", Provenance("test")) as sink:
        for part in np.array_split(np.arange(9000), 7):
            columns = {"roll_rad": roll[part]}
            sink.write_columns("/cf1/attitude", message_class("Attitude"), times[part], columns)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert sum(1 for _ in read_raw(tmp_path / "b.mcap")) == 9000


def test_columns_are_checked_as_messages_are(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink:
        times = np.array([5, 7])
        sink.write_columns(
            "/a", message_class("Height"), times, {"height_m": 1.0}, publish_ns=times + 1
        )
        with pytest.raises(RecordingError, match="negative"):
            sink.write_columns("/a", message_class("Height"), times - 6, {"height_m": 1.0})
        with pytest.raises(RecordingError, match="negative"):
            sink.write_columns("/a", message_class("Height"), times - 6, {}, publish_ns=times)
        with pytest.raises(RecordingError, match="negative"):
            late = times - np.array([0, 8])
            sink.write_columns("/a", message_class("Height"), times, {}, publish_ns=late)
        with pytest.raises(RecordingError, match="carries dmrl"):
            sink.write_columns("/cf1/labels", message_class("Height"), times, {})
    assert [(r.time_ns, r.publish_ns) for r in read_raw(tmp_path / "a.mcap")] == [(5, 6), (7, 8)]
