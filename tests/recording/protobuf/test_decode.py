"""The bulk decoder against Google's protobuf parser."""

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given, settings
from hypothesis import strategies as st

from dmrl.messages import message_class
from dmrl.recording.protobuf.decode import decode
from dmrl.recording.protobuf.wire_format import WireError, decode_varints

from .plain_rows import decode_rows

F = FieldDescriptorProto
TYPES = {
    "double": (F.TYPE_DOUBLE, st.floats(allow_nan=False)),
    "float": (F.TYPE_FLOAT, st.floats(width=32, allow_nan=False)),
    "int32": (F.TYPE_INT32, st.integers(-(2**31), 2**31 - 1)),
    "int64": (F.TYPE_INT64, st.integers(-(2**63), 2**63 - 1)),
    "uint32": (F.TYPE_UINT32, st.integers(0, 2**32 - 1)),
    "uint64": (F.TYPE_UINT64, st.integers(0, 2**63 - 1)),
    "sint32": (F.TYPE_SINT32, st.integers(-(2**31), 2**31 - 1)),
    "sint64": (F.TYPE_SINT64, st.integers(-(2**63), 2**63 - 1)),
    "fixed32": (F.TYPE_FIXED32, st.integers(0, 2**32 - 1)),
    "sfixed64": (F.TYPE_SFIXED64, st.integers(-(2**63), 2**63 - 1)),
    "flag": (F.TYPE_BOOL, st.booleans()),
    "text": (F.TYPE_STRING, st.text(max_size=200)),
    "raw": (F.TYPE_BYTES, st.binary(max_size=200)),
}  # fmt: skip


def build_class() -> Any:
    """Build a message class with every scalar type, singular and repeated, and nested once."""
    file = FileDescriptorProto(name="all.proto", package="t", syntax="proto3")
    inner, outer = DescriptorProto(name="Inner"), DescriptorProto(name="Outer")
    for kind in (inner, outer):
        for k, (name, (number, _)) in enumerate(TYPES.items()):
            kind.field.add(name=name, number=k + 1, type=number, label=F.LABEL_OPTIONAL)
            kind.field.add(name=f"{name}_s", number=k + 101, type=number, label=F.LABEL_REPEATED)
    for name, number, label in (("one", 30, F.LABEL_OPTIONAL), ("many", 2000, F.LABEL_REPEATED)):
        outer.field.add(
            name=name, number=number, type=F.TYPE_MESSAGE, type_name=".t.Inner", label=label
        )
    file.message_type.extend([inner, outer])
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return GetMessageClass(pool.FindMessageTypeByName("t.Outer"))


OUTER = build_class()


@st.composite
def contents(draw: st.DrawFn, nested: bool = True) -> dict[str, Any]:
    """Draw random contents of an Outer message, or of an Inner one without nesting."""
    out: dict[str, Any] = {}
    for name, (_, values) in TYPES.items():
        if draw(st.booleans()):
            out[name] = draw(values)
        if draw(st.integers(0, 3)) == 0:
            out[f"{name}_s"] = draw(st.lists(values, max_size=3))
    if nested:
        if draw(st.booleans()):
            out["one"] = draw(contents(nested=False))
        out["many"] = draw(st.lists(contents(nested=False), max_size=2))
    return out


def to_plain(value: Any) -> Any:
    """Return a protobuf message in the form of Arrow's ``to_pylist``."""
    if not hasattr(value, "DESCRIPTOR"):
        return value
    out = {}
    for field in value.DESCRIPTOR.fields:
        got = getattr(value, field.name)
        if field.is_repeated:
            out[field.name] = [to_plain(v) for v in got]
        elif field.message_type is not None:
            out[field.name] = to_plain(got) if value.HasField(field.name) else None
        else:
            out[field.name] = got
    return out


def decode_messages(messages: list[Any]) -> list[dict[str, Any]]:
    """Serialize messages, decode them in bulk, and return a dictionary for each."""
    return decode_rows([m.SerializeToString() for m in messages], messages[0].DESCRIPTOR)


@pytest.mark.heavy
@settings(max_examples=12)
@given(st.lists(contents(), min_size=1, max_size=5))
def test_bulk_decoding_equals_google_protobuf(values: list[dict[str, Any]]) -> None:
    messages = [OUTER(**v) for v in values]
    assert decode_messages(messages) == [to_plain(m) for m in messages]


@settings(max_examples=100)
@given(st.binary(max_size=60))
@pytest.mark.heavy
def test_random_bytes_raise_wire_error_or_decode(data: bytes) -> None:
    array = np.frombuffer(data, np.uint8)
    with suppress(WireError):
        decode(array, np.array([0]), np.array([len(data)]), OUTER.DESCRIPTOR)


def test_labels_with_and_without_peers() -> None:
    label = message_class("PeerLabel")
    values = [
        message_class("PeerLabels")(peers=[label(peer="cf2", box_px=[1, 2, 3, 4], source="truth")]),
        message_class("PeerLabels")(),
        message_class("PeerLabels")(peers=[label(peer="cf2"), label(peer="cf3", u_px=3.5)]),
    ]
    assert decode_messages(values) == [to_plain(v) for v in values]


def test_a_value_beyond_its_message_is_an_error() -> None:
    data = np.frombuffer(message_class("Height")(height_m=1.0).SerializeToString(), np.uint8)
    with pytest.raises(WireError, match="beyond its message"):
        decode(data, np.array([0]), np.array([len(data) - 1]), message_class("Height").DESCRIPTOR)


def test_a_field_of_another_wire_type_is_named() -> None:
    data = np.frombuffer(b"\x08\x05", np.uint8)  # field 1 as a varint; Height has a double
    with pytest.raises(WireError, match=r"dmrl.v1.Height.height_m has wire type 0"):
        decode(data, np.array([0]), np.array([2]), message_class("Height").DESCRIPTOR)


def test_last_of_repeated_scalars_is_used() -> None:
    height = message_class("Height")
    data = height(height_m=1.0).SerializeToString() + height(height_m=2.5).SerializeToString()
    array = np.frombuffer(data + data, np.uint8)
    ends = np.array([len(data), 2 * len(data)])
    got = decode(array, ends - len(data), ends, height.DESCRIPTOR)
    assert got["height_m"].to_pylist() == [2.5, 2.5] == [height.FromString(data).height_m] * 2


@pytest.mark.parametrize("size", [1, 2, 9, 10, 11])
def test_a_varint_has_ten_bytes_at_most(size: int) -> None:
    data = np.frombuffer(b"\x81" * (size - 1) + b"\x01" + bytes(3), np.uint8)
    if size > 10:
        with pytest.raises(WireError, match="longer than ten bytes"):
            decode_varints(data, np.array([0]))
        return
    value, at = decode_varints(data, np.array([0]))
    assert value.tolist() == [sum(1 << 7 * k for k in range(size)) % (1 << 64)]
    assert at.tolist() == [size]
