"""Decoding of messages with definitions of every shape, compared with Google's own decoder."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from google.protobuf.descriptor_pb2 import (
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import Writer

import dmrl
from dmrl.errors import RecordingError
from dmrl.recording.protobuf.definitions import build_type
from dmrl.stages.convert import Settings, run
from dmrl.terminal.left_out import count_left_out

from .definitions_of_any_shape import iter_definitions
from .plain_rows import decode_rows, from_table, read_row

F = FieldDescriptorProto


def compare_decoders(seeds: range) -> int:
    """Decode messages of random definitions; return how many were compared."""
    count = 0
    for made, pool in iter_definitions(seeds):
        schema = made.build_schema()
        for name in made.messages:
            theirs, ours = pool.FindMessageTypeByName(name[1:]), build_type(name[1:], schema)
            parts = made.build_payloads(theirs, 6)
            wanted = [read_row(GetMessageClass(theirs).FromString(part)) for part in parts]
            got = [from_table(row, ours) for row in decode_rows(parts, ours)]
            assert repr(got) == repr(wanted), (made.rng, name)
            count += len(parts)
    return count


@pytest.mark.heavy
def test_definitions_of_every_shape_decode_as_google_decodes_them() -> None:
    assert compare_decoders(range(25)) > 250


@pytest.mark.slow
def test_two_thousand_definitions_decode_as_google_decodes_them() -> None:
    assert compare_decoders(range(1000, 3000)) > 20_000


def add_message(file: FileDescriptorProto, name: str, **fields: Any) -> None:
    """Add a message to a file; ``fields`` gives the type of each field by its name."""
    added = file.message_type.add(name=name)
    for number, (field, kind) in enumerate(fields.items(), 1):
        held = added.field.add(name=field, number=number, label=F.LABEL_OPTIONAL)
        held.json_name = f"json{number}"
        held.type = kind if isinstance(kind, int) else F.TYPE_MESSAGE
        if isinstance(kind, str):
            held.type_name = kind


def build_file(name: str, package: str = "my", **more: Any) -> FileDescriptorProto:
    return FileDescriptorProto(name=name, package=package, syntax="proto3", **more)


def build_class(name: str, *files: FileDescriptorProto) -> Any:
    """Return Google's class of a message; files precede those that import them."""
    pool = DescriptorPool()
    for file in files:
        pool.AddSerializedFile(file.SerializeToString())
    return GetMessageClass(pool.FindMessageTypeByName(name))


Sent = tuple[str, str, bytes, list[bytes]]


def write_recording(path: Path, *sent: Sent) -> Path:
    """Write topics with the mcap package, each with its schema name, schema and messages."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for first, (topic, name, schema, parts) in enumerate(sent):
            number = writer.register_schema(name, "protobuf", schema)
            channel = writer.register_channel(topic, "protobuf", number)
            for k, data in enumerate(parts):
                time_ns = 10**18 + k * 10**8 + first
                writer.add_message(channel, time_ns, data, time_ns, sequence=k)
        writer.finish()
    return path


def pack_files(*files: FileDescriptorProto) -> bytes:
    return FileDescriptorSet(file=files).SerializeToString()


def test_missing_imports_of_definitions_are_accepted(tmp_path: Path) -> None:
    """Writers seldom include the imported files that define options of nanopb or validators."""
    file = build_file("m.proto", dependency=["nanopb.proto", "other.proto"])
    add_message(file, "M", x=F.TYPE_DOUBLE, far=".other.Far")
    whole = build_file("m.proto", dependency=["other.proto"])
    add_message(whole, "M", x=F.TYPE_DOUBLE, far=".other.Far")
    other = build_file("other.proto", "other")
    add_message(other, "Far", y=F.TYPE_INT32)
    made = build_class("my.M", other, whole)
    data = made(x=1.5, far={"y": 7}).SerializeToString()
    found = dmrl.open(
        write_recording(tmp_path / "a.mcap", ("/x", "my.M", pack_files(file), [data] * 3))
    )
    table = found["/x"].to_arrow()
    assert table["x"].to_pylist() == [1.5] * 3
    assert table["far"].to_pylist() == [b"\x08\x07"] * 3  # its type is defined nowhere


def test_type_defined_in_two_files_is_accepted(tmp_path: Path) -> None:
    one, two = build_file("a.proto"), build_file("dir/a.proto", dependency=["a.proto"])
    for file in (one, two):
        add_message(file, "P", x=F.TYPE_DOUBLE)
    add_message(two, "Q", p=".my.P")
    only = build_file("dir/a.proto", dependency=["a.proto"])
    add_message(only, "Q", p=".my.P")
    data = build_class("my.Q", one, only)(p={"x": 2.5}).SerializeToString()
    path = write_recording(tmp_path / "a.mcap", ("/x", "my.Q", pack_files(two, one), [data]))
    assert dmrl.open(path)["/x"].to_arrow()["p"].to_pylist() == [{"x": 2.5}]


def test_topic_whose_type_grows_has_the_columns_of_every_version(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sent: list[Sent] = []
    inner = build_file("in.proto")
    add_message(inner, "In", a=F.TYPE_INT32)
    for fields in (
        {"x": F.TYPE_DOUBLE, "inner": ".my.In"},
        {"x": F.TYPE_DOUBLE, "inner": ".my.In", "n": F.TYPE_INT32},
        {"x": F.TYPE_STRING, "inner": ".my.In", "n": F.TYPE_INT64},
    ):
        file = build_file("m.proto", dependency=["in.proto"])
        add_message(file, "M", **fields)
        made = build_class("my.M", inner, file)
        text = "one" if fields["x"] == F.TYPE_STRING else 1.0
        values = {"x": text, "inner": {"a": 4}} | ({"n": 9} if "n" in fields else {})
        data = [made(**values).SerializeToString()] * 4
        sent.append(("/x", "my.M", pack_files(file, inner), data))
    table = dmrl.open(write_recording(tmp_path / "a.mcap", *sent))["/x"].to_arrow()
    assert (np.diff(table["log_time"].to_numpy()) > 0).all()
    assert table["x"].to_pylist() == [1.0, 1.0, None] * 4
    assert table["x_"].to_pylist() == [None, None, "one"] * 4
    assert table["n"].to_pylist() == [None, 9, 9] * 4
    assert table["inner"].to_pylist() == [{"a": 4}] * 12
    assert "/x: x has several types: one of them is x_" in capsys.readouterr().err
    assert dmrl.open(tmp_path / "a.mcap")["/x"].to_arrow(fields=["n"])["n"].null_count == 4


def test_third_party_type_with_our_name_keeps_its_own_fields(tmp_path: Path) -> None:
    short = build_file("h.proto", "")
    add_message(short, "Height", height_m=F.TYPE_STRING)
    newer = build_file("n.proto", "dmrl.v1")
    add_message(newer, "Height", height_m=F.TYPE_DOUBLE, floor=F.TYPE_INT32)
    odd = build_file("o.proto", "dmrl.v1")
    add_message(odd, "Height", metres=F.TYPE_DOUBLE)
    older = build_file("e.proto", "dmrl.v1")
    add_message(older, "Height")
    sent: list[Sent] = [
        (
            "/a",
            "Height",
            pack_files(short),
            [build_class("Height", short)(height_m="2 m").SerializeToString()],
        ),
        (
            "/cf1/height",
            "dmrl.v1.Height",
            pack_files(newer),
            [build_class("dmrl.v1.Height", newer)(height_m=2, floor=3).SerializeToString()],
        ),
        ("/cf2/height", "dmrl.v1.Height", pack_files(odd), [b""]),
        ("/b", "dmrl.v1.Height", pack_files(odd), [b""]),
        ("/cf3/height", "dmrl.v1.Height", pack_files(older), [b""]),
    ]
    found = dmrl.open(write_recording(tmp_path / "a.mcap", *sent))
    assert found["/a"].to_arrow()["height_m"].to_pylist() == ["2 m"]
    assert found["/cf1/height"].to_arrow()["floor"].to_pylist() == [3]
    assert found["/b"].to_arrow().column_names[2:] == ["metres"]
    assert found["/cf3/height"].to_arrow()["height_m"].to_pylist() == [0.0]  # as our own default
    with pytest.raises(RecordingError, match=r"/cf2/height carries another dmrl.v1.Height"):
        found["/cf2/height"].to_arrow()


def test_fields_named_like_time_columns_are_renamed(tmp_path: Path) -> None:
    file = FileDescriptorProto(name="m.proto", package="my", syntax="proto2")
    names = ("log_time", "log_time_", "publish_time", "time_s", "status")
    add_message(file, "M", **dict.fromkeys(names, F.TYPE_STRING))
    data = build_class("my.M", file)(**{name: name for name in names}).SerializeToString()
    path = write_recording(tmp_path / "a.mcap", ("/x", "my.M", pack_files(file), [data] * 2))
    topic = dmrl.open(path)["/x"]
    table, frame, array = topic.to_arrow(), topic.to_pandas(), topic.to_numpy()
    for held in (table, frame, array):
        assert list(held["log_time"]) == [10**18, 10**18 + 10**8] or table is held
        assert [str(v) for v in held["log_time__"]] == ["log_time"] * 2
        assert [str(v) for v in held["log_time_"]] == ["log_time_"] * 2
        assert [str(v) for v in held["publish_time_"]] == ["publish_time"] * 2
    assert table["log_time"].to_pylist() == [10**18, 10**18 + 10**8]
    assert frame.index.tolist() == [0.0, 0.1] and list(frame["time_s_"]) == ["time_s"] * 2
    assert list(frame["status"]) == ["status"] * 2
    run(path, tmp_path / "csv", Settings(to="csv"))
    lines = (tmp_path / "csv" / "x.csv").read_text().splitlines()
    assert lines[0] == "log_time,publish_time,log_time__,log_time_,publish_time_,time_s,status"
    assert lines[1].startswith("1000000000000000000,1000000000000000000,log_time,log_time_,")


def test_invalid_definition_gives_one_line_error(tmp_path: Path) -> None:
    file = build_file("m.proto")
    add_message(file, "M", x=F.TYPE_DOUBLE)
    sent: list[Sent] = [("/x", "my.Other", pack_files(file), [b""]), ("/y", "my.M", b"\xff", [b""])]
    found = dmrl.open(write_recording(tmp_path / "a.mcap", *sent))
    for topic in ("/x", "/y"):
        with pytest.raises(
            RecordingError, match=f"{topic} has a schema .* that cannot be used"
        ) as e:
            found[topic].to_arrow()
        assert "damaged" not in str(e.value)


def test_topic_without_protobuf_does_not_prevent_tables_of_others(tmp_path: Path) -> None:
    file = build_file("m.proto")
    add_message(file, "M", x=F.TYPE_DOUBLE)
    data = build_class("my.M", file)(x=1.5).SerializeToString()
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, encoding, schema in (
            ("/x", "protobuf", writer.register_schema("my.M", "protobuf", pack_files(file))),
            ("/note", "json", writer.register_schema("N", "jsonschema", b"{}")),
            ("/odd", "protobuf", writer.register_schema("my.Odd", "protobuf", pack_files(file))),
        ):
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(channel, 5, data, 5)
        writer.finish()
    with count_left_out() as left:
        assert run(path, tmp_path / "csv", Settings(to="csv")) == {"/x": 1}
    assert sorted(name.name for name in (tmp_path / "csv").iterdir()) == ["x.csv"]
    why = 'cannot be used: "Couldn\'t find message my.Odd"'
    assert dict(left.counts) == {
        "messages on /note, which is json, not protobuf": 1,
        f"messages on /odd, which has a schema my.Odd that {why}": 1,
    }


def test_an_absent_message_with_a_list_in_it_keeps_its_row(tmp_path: Path) -> None:
    file = build_file("m.proto")
    add_message(file, "P", a=F.TYPE_INT32)
    add_message(file, "L")
    file.message_type[1].field.add(
        name="p", number=1, label=F.LABEL_REPEATED, type=F.TYPE_MESSAGE, type_name=".my.P"
    )
    add_message(file, "M", held=".my.L")
    data = build_class("my.M", file)(held={"p": [{"a": 1}, {"a": 2}]}).SerializeToString()
    path = write_recording(tmp_path / "a.mcap", ("/x", "my.M", pack_files(file), [b"", data]))
    assert len(dmrl.open(path)["/x"].to_pandas()) == 3


def test_message_with_too_many_columns_becomes_json(tmp_path: Path) -> None:
    """Ten types with ten fields of the previous type would be a table of 10**10 columns."""
    file = build_file("m.proto")
    add_message(file, "T0", a=F.TYPE_INT32)
    for k in range(1, 11):
        add_message(file, f"T{k}", **{f"f{n}": f".my.T{k - 1}" for n in range(10)})
    made = build_class("my.T10", file)
    value = made()
    value.f3.f3.f3.SetInParent()
    path = write_recording(
        tmp_path / "a.mcap", ("/x", "my.T10", pack_files(file), [value.SerializeToString()])
    )
    table = dmrl.open(path)["/x"].to_arrow()
    assert table["f3"].to_pylist() == ['{"f3": {"f3": {}}}'] and table["f4"].to_pylist() == [None]


@pytest.mark.parametrize(
    ("name", "rows", "columns"),
    [
        ("timestamp_root_first", 5, {"stamp", "x"}),
        ("deps_reverse_order", 5, {"v"}),
        ("google_struct", 5, {"x", "extra"}),
        ("schema_evolved_one_topic", 6, {"x", "y"}),
        ("field_named_log_time", 5, {"log_time_", "publish_time_", "time_s"}),
    ],
)
def test_third_party_protobuf_files_are_read(
    name: str, rows: int, columns: set[str], data: Path
) -> None:
    found = dmrl.open(data / "strangers" / f"pb-{name}" / f"{name}.mcap")
    (topic,) = found.topics
    table = found[topic].to_arrow()
    assert len(table) == rows and set(table.column_names[2:]) == columns
    assert (np.diff(table["log_time"].to_numpy()) > 0).all()
    assert table["log_time"][0].as_py() == 10**18


def test_field_named_like_a_time_column_gets_its_own_csv_column(data: Path, tmp_path: Path) -> None:
    name = "field_named_log_time"
    source = data / "strangers" / f"pb-{name}" / f"{name}.mcap"
    run(source, tmp_path / "out", Settings(to="csv"))
    (table,) = (tmp_path / "out").glob("*.csv")
    found = pandas.read_csv(table)
    assert found["log_time"].tolist() == [10**18 + k * 10**8 for k in range(len(found))]
    own = dmrl.open(source)
    (topic,) = own.topics
    assert found["log_time_"].tolist() == own[topic].to_arrow()["log_time_"].to_pylist()
    assert found["log_time_"].tolist() != found["log_time"].tolist()
