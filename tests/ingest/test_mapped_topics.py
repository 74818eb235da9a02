"""Column maps for topics: equal numbers in protobuf, JSON and ROS give equal recordings."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import (
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import dmrl
from dmrl.errors import SourceError
from dmrl.stages.convert import Settings, run
from dmrl.terminal.left_out import count_left_out

F = FieldDescriptorProto
START_NS = 1_700_000_000_000_000_000
COUNT = 50

TABLE = """
[names]
red = "cf1"

[roll]
name = "/{robot}/att:angles.roll"
unit = "deg"
[pitch]
name = "/{robot}/att:angles.pitch"
unit = "deg"
sign = -1
[yaw_rate]
name = "/{robot}/att:rate"
unit = "rad/s"
[vx]
name = "/{robot}/move:v.0"
unit = "cm/s"
frame = "horizontal"
[vy]
name = "/{robot}/move:v.1"
unit = "cm/s"
frame = "horizontal"
[height]
name = "/{robot}/move:alt"
unit = "mm"
[range.cf2]
name = "/{robot}/uwb:d"
unit = "m"
held = false
"""
KINDS: dict[str, dict[str, Any]] = {
    "Angles": {"roll": "double", "pitch": "double"},
    "Att": {"angles": "Angles", "rate": "double"},
    "Move": {"v": ["double"], "alt": "int32"},
    "Uwb": {"d": "double", "label": "string"},
}
SCALARS = {"double": F.TYPE_DOUBLE, "int32": F.TYPE_INT32, "string": F.TYPE_STRING}
ROS = {"double": "float64", "int32": "int32", "string": "string"}


def build_messages(robot: str) -> list[tuple[str, str, int, dict[str, Any]]]:
    """Return topic, type, time in ns and content of all messages of a robot."""
    out: list[tuple[str, str, int, dict[str, Any]]] = []
    for k in range(COUNT):
        t = START_NS + k * 20_000_000
        turned = {"roll": 1.0 + k, "pitch": 2.0}
        out.append((f"/{robot}/att", "Att", t, {"angles": turned, "rate": 0.5}))
        out.append((f"/{robot}/move", "Move", t + 7, {"v": [100.0, -50.0 - k], "alt": 1000 + k}))
        out.append((f"/{robot}/uwb", "Uwb", t + 9, {"d": 1.5 + 0.01 * k, "label": "a"}))
    return out


def write_protobuf(path: Path, sent: list[tuple[str, str, int, dict[str, Any]]]) -> Path:
    """Write the messages to an MCAP file in protobuf."""
    file = FileDescriptorProto(name="k.proto", package="my", syntax="proto3")
    for name, fields in KINDS.items():
        kind = file.message_type.add(name=name)
        for number, (field, of) in enumerate(fields.items(), 1):
            held = kind.field.add(name=field, number=number, label=F.LABEL_OPTIONAL)
            if isinstance(of, list):
                held.label, of = F.LABEL_REPEATED, of[0]
            held.type = SCALARS.get(of, F.TYPE_MESSAGE)
            if of not in SCALARS:
                held.type_name = f".my.{of}"
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    schema = FileDescriptorSet(file=[file]).SerializeToString()

    def encode(kind: str, content: dict[str, Any]) -> bytes:
        made = GetMessageClass(pool.FindMessageTypeByName(f"my.{kind}"))(**content)
        return bytes(made.SerializeToString())

    return write_mcap(path, sent, "protobuf", "protobuf", schema, encode)


def write_json(path: Path, sent: list[tuple[str, str, int, dict[str, Any]]]) -> Path:
    return write_mcap(path, sent, "jsonschema", "json", b"{}", lambda _, c: json.dumps(c).encode())


def write_mcap(
    path: Path,
    sent: list[tuple[str, str, int, dict[str, Any]]],
    schema_encoding: str,
    encoding: str,
    schema: bytes,
    encode: Callable[[str, dict[str, Any]], bytes],
) -> Path:
    """Write messages to an MCAP file with the given encodings."""
    path = path.with_suffix(".mcap")
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels: dict[str, int] = {}
        for topic, kind, time_ns, content in sent:
            if topic not in channels:
                number = writer.register_schema(f"my.{kind}", schema_encoding, schema)
                channels[topic] = writer.register_channel(topic, encoding, number)
            writer.add_message(channels[topic], time_ns, encode(kind, content), time_ns)
        writer.finish()
    return path


def write_ros(path: Path, sent: list[tuple[str, str, int, dict[str, Any]]]) -> Path:
    """Write the messages to a ROS 2 bag."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, fields in KINDS.items():
        lines = [
            f"{ROS[of[0]]}[] {n}" if isinstance(of, list) else f"{ROS.get(of, f'my/{of}')} {n}"
            for n, of in fields.items()
        ]
        store.register(get_types_from_msg("\n".join(lines), f"my/msg/{name}"))

    def build(kind: str, content: dict[str, Any]) -> Any:
        values = {
            name: build(KINDS[kind][name], value)
            if isinstance(value, dict)
            else np.array(value)
            if isinstance(value, list)
            else value
            for name, value in content.items()
        }
        return store.types[f"my/msg/{kind}"](**values)

    with BagWriter(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, time_ns, content in sent:
            name = f"my/msg/{kind}"
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            data = store.serialize_cdr(build(kind, content), name)
            writer.write(connections[topic], time_ns, bytes(data))
    return path


@pytest.mark.parametrize("write", [write_protobuf, write_json, write_ros])
@pytest.mark.heavy
def test_column_map_reads_topics_of_any_encoding(
    write: Callable[[Path, Any], Path], tmp_path: Path
) -> None:
    other = [one for one in build_messages("cf2") if one[1] != "Uwb"]
    source = write(tmp_path / "a", build_messages("red") + other)
    (tmp_path / "map.toml").write_text(TABLE)
    with count_left_out() as left:
        run(source, tmp_path / "out.mcap", Settings(columns=tmp_path / "map.toml"))
    assert not left.counts
    found = dmrl.open(tmp_path / "out.mcap")
    wanted = {f"/{r}/{t}" for r in ("cf1", "cf2") for t in ("attitude", "velocity", "height")}
    assert set(found.topics) == wanted | {"/cf1/range/cf2"}
    attitude = found["/cf1/attitude"].to_pandas()
    np.testing.assert_allclose(attitude["roll_rad"], np.radians(1.0 + np.arange(COUNT)), atol=1e-9)
    np.testing.assert_allclose(attitude["pitch_rad"], np.radians(-2.0), atol=1e-9)
    np.testing.assert_allclose(attitude["yaw_rate_radps"], 0.5, atol=1e-6)
    velocity = found["/cf2/velocity"].to_pandas()
    np.testing.assert_allclose(velocity["vx_mps"], 1.0)
    np.testing.assert_allclose(velocity["vy_mps"], -0.5 - 0.01 * np.arange(COUNT))
    times = START_NS + np.arange(COUNT) * 20_000_000
    np.testing.assert_array_equal(velocity["log_time"], times + 7)
    np.testing.assert_allclose(found["/cf1/height"].to_pandas()["height_m"].iloc[-1], 1.049)
    np.testing.assert_array_equal(found["/cf1/range/cf2"].to_pandas()["log_time"], times + 9)


def test_topics_not_in_the_table_are_reported_as_left_out(tmp_path: Path) -> None:
    source = write_json(
        tmp_path / "a", [*build_messages("red"), ("/chat", "Uwb", START_NS, {"d": 1.0})]
    )
    (tmp_path / "map.toml").write_text(TABLE)
    with count_left_out() as left:
        run(source, tmp_path / "out.mcap", Settings(columns=tmp_path / "map.toml"))
    assert dict(left.counts) == {"messages on /chat: my.Uwb in json is not converted": 1}


def test_fields_that_are_no_number_are_counted(tmp_path: Path) -> None:
    some = build_messages("red")
    some[1][3]["alt"], some[4][3]["alt"] = "low", None  # null is a missing value, not a wrong one
    source = write_json(tmp_path / "a", some)
    (tmp_path / "map.toml").write_text(TABLE)
    with count_left_out() as left:
        run(source, tmp_path / "out.mcap", Settings(columns=tmp_path / "map.toml"))
    assert dict(left.counts) == {"cells of '/red/move:alt' that are no number": 1}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (
            '[height]\nvalue = 1\nunit = "m"\n',
            r"\[height\] value: constants are for text files",
        ),
        (TABLE.replace(":rate", ":turn"), r"in /red/att:turn\. Name another field: \w+, \w+"),
        (TABLE.replace("uwb:d", "radio:d"), r"no column /red/radio:d"),
        (TABLE.replace("uwb:d", "uwb:label"), r"has a number in /red/uwb:label"),
        (TABLE.replace('"cf1"', "3"), r"\[names\]: not new names"),
    ],
)
def test_table_that_fits_no_topic_gives_one_line_error(text: str, why: str, tmp_path: Path) -> None:
    source = write_json(tmp_path / "a", build_messages("red"))
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(SourceError, match=why) as e:
        run(source, tmp_path / "out.mcap", Settings(columns=tmp_path / "map.toml"))
    assert "\n" not in str(e.value) and not (tmp_path / "out.mcap").exists()


def test_time_can_be_read_from_a_field(tmp_path: Path) -> None:
    sent = [("/s", "Uwb", START_NS + k, {"z": 1.0, "t": 5 + 0.5 * k}) for k in range(20)]
    table = '[time]\nname = ":t"\nunit = "s"\n[height]\nname = "/s:z"\nunit = "m"\n'
    (tmp_path / "map.toml").write_text(table)
    source = write_json(tmp_path / "a", sent)
    run(source, tmp_path / "out.mcap", Settings(columns=tmp_path / "map.toml", robot="cf4"))
    times = dmrl.open(tmp_path / "out.mcap")["/cf4/height"].to_arrow()["log_time"].to_pylist()
    assert times == [5_000_000_000 + k * 500_000_000 for k in range(20)]
