"""Recordings of other writers: concatenated files, and wrong types on known topics."""

from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.writer import IndexType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

import dmrl
from dmrl.errors import RecordingError
from dmrl.recording import check, read_summary, recover


def write_foreign_recording(path: Path, *sent: tuple[str, Any]) -> Path:
    """Write these messages, 1 ns apart, to a file without a summary."""
    with path.open("wb") as stream:
        writer = Writer(
            stream,
            index_types=IndexType.NONE,
            repeat_channels=False,
            repeat_schemas=False,
            use_statistics=False,
            use_summary_offsets=False,
        )
        writer.start()
        for k, (topic, message) in enumerate(sent):
            kind = build_file_descriptor_set(type(message)).SerializeToString()
            schema = writer.register_schema(message.DESCRIPTOR.full_name, "protobuf", kind)
            channel = writer.register_channel(topic, "protobuf", schema)
            writer.add_message(channel, 10**9 + k, message.SerializeToString(), 10**9 + k)
        writer.finish()
    return path


def test_joined_files_are_refused_and_recovered_as_a_whole(tmp_path: Path) -> None:
    first = write_foreign_recording(tmp_path / "a.mcap", ("/cf1/pose", PoseInFrame()))
    second = write_foreign_recording(tmp_path / "b.mcap", ("/cf2/pose", PoseInFrame()))
    joined = tmp_path / "c.mcap"
    joined.write_bytes(first.read_bytes() + second.read_bytes())
    with pytest.raises(RecordingError, match=r"follow its end, as where two files were joined"):
        read_summary(joined)
    recover(joined, tmp_path / "d.mcap")
    found = dmrl.open(tmp_path / "d.mcap")
    assert {topic: len(found[topic]) for topic in found.topics} == {"/cf1/pose": 1, "/cf2/pose": 1}


def test_bytes_behind_the_end_are_counted(tmp_path: Path) -> None:
    path = write_foreign_recording(tmp_path / "a.mcap", ("/cf1/pose", PoseInFrame()))
    path.write_bytes(path.read_bytes() + b"\0" * 50)
    assert recover(path, tmp_path / "b.mcap").lost_bytes == 50


def test_a_stamped_message_on_the_topic_of_another_is_checked(tmp_path: Path) -> None:
    image, pose = CompressedImage(), PoseInFrame()
    image.timestamp.seconds = pose.timestamp.seconds = 1
    path = write_foreign_recording(
        tmp_path / "a.mcap", ("/cf1/pose", image), ("/cf1/camera/image", pose)
    )
    found = [f.text for f in check(path) if f.level == "error"]
    assert found == [
        "carries foxglove.PoseInFrame, not foxglove.CompressedImage",
        "carries foxglove.CompressedImage, not foxglove.PoseInFrame",
    ]
