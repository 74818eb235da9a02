"""Messages of unknown types are exported to bags and tables completely, or left out by name."""

import re
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as F
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from rosbags.highlevel import AnyReader

from dmrl.errors import RecordingError, UnreadableTopic
from dmrl.exchange.csv_parquet import write_tables
from dmrl.exchange.ros2 import write_bag
from dmrl.messages import message_class
from dmrl.recording import (
    Channel,
    RawMessage,
    RecordingWriter,
    build_provenance,
    read_raw,
    read_table,
)
from dmrl.terminal.left_out import count_left_out

OWN = {"type": F.TYPE_MESSAGE, "type_name": ".x.M"}
MANY = {"label": F.LABEL_REPEATED}


def write_message(
    folder: Path, *fields: dict[str, Any], data: bytes = b"", name: str = "M"
) -> Path:
    """Write a recording with one message, of a new type with these fields."""
    file = FileDescriptorProto(name="x.proto", package="x", syntax="proto3")
    kind = file.message_type.add(name=name)
    entry = kind.nested_type.add(name="Entry")
    entry.options.map_entry = True
    for number, key in enumerate(("key", "value"), 1):
        entry.field.add(name=key, number=number, type=F.TYPE_STRING, label=F.LABEL_OPTIONAL)
    for number, field in enumerate(fields, 1):
        given = {"name": "a", "type": F.TYPE_DOUBLE, "label": F.LABEL_OPTIONAL, **field}
        kind.field.add(number=number, **given)
    channel = Channel("/cf1/m", f"x.{name}", FileDescriptorSet(file=[file]).SerializeToString())
    with RecordingWriter(folder / "in.mcap", build_provenance("test")) as sink:
        sink.write_raw(RawMessage(0, 0, channel, data))
    return folder / "in.mcap"


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        (["_", "b"], ["field", "b"]),
        (["_1"], ["field_1"]),
        (["class", "None"], ["field_class", "none"]),
        (["a", "A", "a_2"], ["a_1", "a_2", "a_2_3"]),
        (["_", "field"], ["field_1", "field_2"]),
    ],
)
def test_fields_in_a_bag_have_valid_ros_names(
    names: list[str], wanted: list[str], tmp_path: Path
) -> None:
    path = write_message(tmp_path, *({"name": name} for name in names))
    write_bag(path, tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        ((connection, _, data),) = reader.messages()
        decoded = reader.deserialize(data, connection.msgtype)
    assert [name for name in vars(decoded) if name != "__msgtype__"] == wanted


@pytest.mark.parametrize(("name", "wanted"), [("_", "Type"), ("_1", "Type1"), ("class", "Class")])
def test_types_in_a_bag_have_valid_ros_names(name: str, wanted: str, tmp_path: Path) -> None:
    write_bag(write_message(tmp_path, {}, name=name), tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        assert [c.msgtype for c in reader.connections] == [f"dmrl_msgs/msg/{wanted}"]


@pytest.mark.parametrize("kind", [F.TYPE_SFIXED32, F.TYPE_SFIXED64])
def test_integers_of_every_type_are_integers_in_a_bag(kind: int, tmp_path: Path) -> None:
    size = 4 if kind == F.TYPE_SFIXED32 else 8
    data = bytes([8 | (5 if size == 4 else 1)]) + (-7).to_bytes(size, "little", signed=True)
    write_bag(write_message(tmp_path, {"type": kind}, data=data), tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        ((connection, _, sent),) = reader.messages()
        assert reader.deserialize(sent, connection.msgtype).a == -7


@pytest.mark.parametrize(
    ("field", "words"),
    [
        (OWN, "contains itself"),
        (OWN | MANY, "contains itself"),
        ({**OWN, **MANY, "type_name": ".x.M.Entry"}, "is a map"),
        ({"type": F.TYPE_BYTES, **MANY}, "a list of bytes"),
    ],
    ids=["itself", "a list of itself", "a map", "a list of bytes"],
)
def test_types_without_ros_equivalent_are_omitted(
    field: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = write_message(tmp_path, field)
    with (
        pytest.raises(RecordingError, match=r"in.mcap has nothing that ROS 2 can hold"),
        count_left_out() as left_out,
    ):
        write_bag(path, tmp_path / "bag")
    assert list(tmp_path.iterdir()) == [path]
    (reason,) = left_out.counts
    assert re.match(rf"messages on /cf1/m that ROS 2 cannot hold: x.M.a .*{words}", reason)
    both = tmp_path / "both.mcap"
    with RecordingWriter(both, build_provenance("test")) as sink:
        for raw in read_raw(path):
            sink.write_raw(raw)
        sink.write(5, "/cf1/height", message_class("Height")(height_m=0.5))
    assert write_bag(both, tmp_path / "bag") == {"/cf1/height": 1}


def test_a_list_of_bytes_is_base64_in_a_table(tmp_path: Path) -> None:
    path = write_message(tmp_path, {"type": F.TYPE_BYTES, **MANY}, data=b"\x0a\x01a\x0a\x01\xff")
    write_tables(path, tmp_path / "out", "csv")
    assert pd.read_csv(tmp_path / "out" / "cf1.m.csv")["a"][0] == '["YQ==", "/w=="]'


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_topic_with_text_that_is_not_utf_8_is_left_out(kind: str, tmp_path: Path) -> None:
    path = write_message(tmp_path, {"type": F.TYPE_STRING}, data=b"\x0a\x02\xed\xa0")
    with (
        pytest.raises(RecordingError, match="has no topic that can be read"),
        count_left_out() as left_out,
    ):
        write_tables(path, tmp_path / "out", kind)  # type: ignore[arg-type]
    why = "has messages that are not of its type (a text is not UTF-8)"
    assert left_out.counts == {f"messages on /cf1/m, which {why}": 1}
    with pytest.raises(UnreadableTopic, match=r"Leave it out \(dmrl trim\)"):
        read_table(path, "/cf1/m")
    assert list(tmp_path.iterdir()) == [path]
