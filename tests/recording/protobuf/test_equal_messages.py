"""The fast decoder of messages of one byte layout, compared with Google's protobuf parser."""

from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given
from hypothesis import strategies as st

from dmrl.recording.mcap.message_batch import Bytes, Ints
from dmrl.recording.protobuf.decode import decode, list_columns
from dmrl.recording.protobuf.equal_messages import decode_equal
from dmrl.recording.protobuf.wire_format import WireError

F = FieldDescriptorProto
TYPES = {
    "x": (F.TYPE_DOUBLE, st.floats(allow_nan=False)),
    "y": (F.TYPE_DOUBLE, st.floats(allow_nan=False)),
    "z": (F.TYPE_FLOAT, st.floats(width=32, allow_nan=False)),
    "count": (F.TYPE_FIXED32, st.integers(0, 2**32 - 1)),
    "time_ns": (F.TYPE_SFIXED64, st.integers(-(2**63), 2**63 - 1)),
}


def build_class() -> Any:
    """Build a message class whose fields all have a fixed size."""
    file = FileDescriptorProto(name="fixed.proto", package="t", syntax="proto3")
    kind = file.message_type.add(name="Fixed")
    for number, (name, (of, _)) in enumerate(TYPES.items(), start=1):
        kind.field.add(name=name, number=number, type=of, label=F.LABEL_OPTIONAL)
    assert isinstance(kind, DescriptorProto)
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return GetMessageClass(pool.FindMessageTypeByName("t.Fixed"))


FIXED = build_class()
FIELDS: dict[str, FieldDescriptor] = list_columns(FIXED.DESCRIPTOR)
BETWEEN = b"\xff" * 31  # stands for the header of each message record


def lay_out(parts: list[bytes]) -> tuple[Bytes, Ints, Ints]:
    """Return bytes that contain these messages, and the start and end offset of each."""
    sizes = np.array([len(part) for part in parts])
    end = np.cumsum(sizes + len(BETWEEN))
    return np.frombuffer(b"".join(BETWEEN + p for p in parts), np.uint8), end - sizes, end


rows = st.fixed_dictionaries({}, optional={name: values for name, (_, values) in TYPES.items()})


@given(st.lists(rows, min_size=2, max_size=6))
@pytest.mark.heavy
def test_decoded_values_equal_google_protobuf(contents: list[dict[str, Any]]) -> None:
    messages = [FIXED(**row) for row in contents]
    at = lay_out([message.SerializeToString() for message in messages])
    alike = decode_equal(*at, FIELDS)
    layouts = {tuple(field.number for field, _ in message.ListFields()) for message in messages}
    assert (alike is None) == (layouts == {()} or len(layouts) > 1)
    for name, values in (alike or {}).items():
        assert values.tolist() == [getattr(message, name) for message in messages]


def test_fields_that_only_another_column_needs_are_skipped() -> None:
    at = lay_out([FIXED(x=k + 1, y=k + 2, z=k + 3).SerializeToString() for k in range(3)])
    alike = decode_equal(*at, {"y": FIELDS["y"]})
    assert alike is not None and {k: v.tolist() for k, v in alike.items()} == {"y": [2, 3, 4]}


def test_last_value_of_a_field_that_occurs_twice_is_used() -> None:
    once = [FIXED(x=k + 1.0).SerializeToString() for k in range(4)]
    alike = decode_equal(*lay_out([once[0] + once[1], once[2] + once[3]]), FIELDS)
    assert alike is not None and alike["x"].tolist() == [2.0, 4.0]


@pytest.mark.parametrize(
    "parts",
    [
        pytest.param([b"\x09" + bytes(8), b"\x11" + bytes(8)], id="other fields of the same size"),
        pytest.param([b"\x0d" + bytes(4)] * 2, id="another wire type than the field's"),
        pytest.param([b"\x09" + bytes(7)] * 2, id="cut within a value"),
        pytest.param([b"\x01" + bytes(8)] * 2, id="field 0"),
        pytest.param([b"\x81\x01" + bytes(8)] * 2, id="a tag of two bytes"),
        pytest.param([b"\x08\x05"] * 2, id="a value of no fixed size"),
        pytest.param([b"\x09" + bytes(8)], id="one message"),
    ],
)
def test_unequal_or_damaged_messages_are_left_to_the_general_decoder(
    parts: list[bytes],
) -> None:
    assert decode_equal(*lay_out(parts), FIELDS) is None


def test_irregularly_spaced_messages_are_left_to_the_general_decoder() -> None:
    data, start, end = lay_out([FIXED(x=k + 1).SerializeToString() for k in range(4)])
    some = [0, 1, 3]
    assert decode_equal(data, start[some], end[some], FIELDS) is None
    assert decode_equal(data, start[::-1], end[::-1], FIELDS) is None
    assert decode(data, start[some], end[some], FIXED.DESCRIPTOR)["x"].to_pylist() == [1, 2, 4]


def test_a_message_beyond_the_data_is_an_error() -> None:
    data, start, end = lay_out([FIXED(x=k + 1).SerializeToString() for k in range(3)])
    with pytest.raises(WireError, match="beyond"):
        decode(data[:-1], start, end, FIXED.DESCRIPTOR)
