"""Topics of a recording loaded into memory."""

from pathlib import Path

import pytest
from mcap.writer import Writer

from dmrl.errors import MissingTopic, RecordingError
from dmrl.messages import serialize_schema
from dmrl.recording import read, read_table
from dmrl.recording.loaded import LoadedRecording


@pytest.mark.heavy
def test_loaded_topics_equal_read_topics(flight: Path) -> None:
    for wanted in (("/{robot}/attitude", "/{robot}/range/{peer}"), ()):
        held = LoadedRecording(flight, *wanted)
        for topic in ("/cf1/attitude", "/cf1/range/cf2", "/cf1/camera/calibration"):
            assert held.get_table(topic) == read_table(flight, topic)
            some = zip(held.iter_messages(topic), read(flight, topic), range(50), strict=False)
            assert all(one == other for one, other, _ in some)
            assert (
                held.get_times(topic).tolist() == read_table(flight, topic)["log_time"].to_pylist()
            )
        fields = ["roll_rad"]
        assert held.get_table("/cf1/attitude", fields) == read_table(
            flight, "/cf1/attitude", fields=fields
        )
        assert held.get_times("/nobody").tolist() == []
        assert (held.start_ns, held.topics.keys()) == (0, held.summary.topics.keys())


def test_decoded_columns_equal_those_of_the_messages(flight: Path) -> None:
    columns = {"/{robot}/attitude": ("roll_rad",), "/{robot}/range/{peer}": ("range_m",)}
    calibration = "/cf1/camera/calibration"
    held = LoadedRecording(flight, "/{robot}/camera/calibration", "/cf1/attitude", columns=columns)
    for topic, fields in (("/cf1/attitude", ["roll_rad"]), ("/cf1/range/cf2", ["range_m"])):
        wanted = read_table(flight, topic, fields=fields)
        assert held.get_table(topic, fields) == wanted
        # The first call hands over the decoded columns, so the second reads the file again.
        assert held.get_table(topic, fields) == wanted
        assert held.get_table(topic) == read_table(flight, topic)
        assert held.get_times(topic).tolist() == wanted["log_time"].to_pylist()
    assert held.get_table(calibration) == read_table(flight, calibration)


def write_undecodable_message(path: Path, topic: str, schema: str) -> Path:
    """Write one message with a field of the wrong wire type, under this schema."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        number = writer.register_schema(f"dmrl.v1.{schema}", "protobuf", serialize_schema(schema))
        channel = writer.register_channel(topic, "protobuf", number)
        writer.add_message(channel, 7, b"\x08\x05", 7)
        writer.finish()
    return path


def test_errors_name_the_file_and_the_topic(tmp_path: Path, flight: Path) -> None:
    path = write_undecodable_message(tmp_path / "a.mcap", "/cf1/height", "Height")
    where = r"a\.mcap.*/cf1/height"
    for call in (
        lambda: LoadedRecording(path).get_table("/cf1/height"),
        lambda: LoadedRecording(path, "/{robot}/height").get_table("/cf1/height"),
        lambda: LoadedRecording(path, columns={"/{robot}/height": ("height_m",)}),
        lambda: read_table(path, "/cf1/height"),
    ):
        with pytest.raises(RecordingError, match=where):
            call()
    with pytest.raises(MissingTopic, match=r"no topic /cf1/heights .*flight\.mcap.*"):
        LoadedRecording(flight).get_table("/cf1/heights")
    other = write_undecodable_message(tmp_path / "b.mcap", "/cf1/labels", "Height")
    for wanted in ((), ("/{robot}/labels",)):
        with pytest.raises(RecordingError, match=r"b\.mcap: /cf1/labels carries dmrl\.v1\.Height"):
            LoadedRecording(other, *wanted).get_table("/cf1/labels")
