"""Decode protobuf messages to Arrow columns, thousands at a time.

The wire format is decoded field by field over all messages of a batch at once (`wire_format`). A
batch of messages of one layout (nearly every sensor topic) takes a few NumPy calls per field.
Source: Protocol Buffers encoding specification.
"""

import json
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from google.protobuf import json_format, text_format
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from numpy.typing import NDArray

from dmrl.guards import limits
from dmrl.recording.mcap.message_batch import Bytes, Ints
from dmrl.recording.protobuf import wire_format
from dmrl.recording.protobuf.arrow_arrays import to_arrow
from dmrl.recording.protobuf.equal_messages import decode_equal
from dmrl.recording.protobuf.wire_format import FieldSpans, WireError
from dmrl.terminal.progress import say_once

F = FieldDescriptor
WITHOUT_UTF8_CHECK = 3
"""Value of the feature ``utf8_validation`` for texts that need not be UTF-8."""


@lru_cache(maxsize=1024)
def list_columns(kind: Descriptor) -> dict[str, FieldDescriptor]:
    """Return the fields of a message by column; an extension is ``[its.full.name]``, as in JSON."""
    columns = {f.name: f for f in kind.fields}
    if kind.is_extendable:
        extensions = sorted(kind.file.pool.FindAllExtensions(kind), key=lambda f: f.number)
        columns |= {f"[{f.full_name}]": f for f in extensions}
    return columns


def decode(
    data: Bytes, start: Ints, end: Ints, descriptor: Descriptor, fields: Sequence[str] | None = None
) -> dict[str, pa.Array]:
    """Decode messages to Arrow columns, one per field, by name.

    Parameters
    ----------
    data
        Bytes that contain the messages.
    start, end
        (N,) range of each message in ``data``.
    descriptor
        Message type.
    fields
        Fields to decode. None: all.

    Returns
    -------
    dict[str, pa.Array]
        (N,) each, in schema order, then extensions. An absent field has its protobuf default; an
        absent sub-message is null. Repeated fields are lists, maps lists of keys and values, enums
        int32. A message that contains itself, or has too many fields, is JSON text.

    Raises
    ------
    WireError
        If the bytes do not conform to the wire format or the type.
    """
    wanted = {
        name: f for name, f in list_columns(descriptor).items() if fields is None or name in fields
    }
    if not wanted:
        return {}
    if _has_rare_fields(descriptor):
        data, start, end = _rewrite(data, start, end, descriptor)
    try:
        return _decode_fields(data, start, end, wanted)
    except _RepeatedError:
        return _decode_fields(*_rewrite(data, start, end, descriptor), wanted)


class _RepeatedError(Exception):
    """A sub-message occurs several times in a message. Google's decoder merges them."""


@lru_cache(maxsize=1024)
def _has_rare_fields(kind: Descriptor) -> bool:
    """Return whether a type has a oneof, a map or a closed enum, or sub-messages that do."""
    seen: set[Descriptor] = set()
    held = [kind]
    while held:
        one = held.pop()
        seen.add(one)
        columns = list_columns(one).values()
        if one.GetOptions().map_entry or any(len(oneof.fields) > 1 for oneof in one.oneofs):
            return True
        if any(f.enum_type is not None and f.enum_type.is_closed for f in columns):
            return True
        inner = (f.message_type for f in columns)
        held += [message for message in inner if message is not None and message not in seen]
    return False


def _rewrite(data: Bytes, start: Ints, end: Ints, kind: Descriptor) -> tuple[Bytes, Ints, Ints]:
    """Write messages again by Google's decoder: of what excludes or replaces another, the last.

    Oneofs, keys of maps, numbers of closed enums and occurrences of sub-messages are then unique.
    """
    build = GetMessageClass(kind)
    parts = []
    for message in (
        _parse(build, data, *at) for at in zip(start.tolist(), end.tolist(), strict=True)
    ):
        message.DiscardUnknownFields()
        parts.append(message.SerializePartialToString(deterministic=True))
    ends = np.cumsum([len(part) for part in parts], dtype=np.int64)
    starts = np.concatenate([[0], ends[:-1]]).astype(np.int64)[: len(parts)]
    return np.frombuffer(b"".join(parts), np.uint8), starts, ends


def _parse(build: Any, data: Bytes, first: int, last: int) -> Any:
    try:
        return build.FromString(data[first:last].tobytes())
    except DecodeError as e:
        raise WireError(f"{build.DESCRIPTOR.full_name}: {e}") from None


def _decode_fields(
    data: Bytes, start: Ints, end: Ints, fields: dict[str, FieldDescriptor]
) -> dict[str, pa.Array]:
    alike = decode_equal(data, start, end, fields)
    if alike is not None:
        return {name: to_arrow(values) for name, values in alike.items()}
    numbers = {f.number: f for f in fields.values()}
    found = wire_format.find_fields(data, start, end, set(numbers))
    for number, spans in found.items():
        found[number] = _select_valid(data, numbers[number], spans)
    return {
        name: _decode_field(data, len(start), found.get(f.number, []), f)
        for name, f in fields.items()
    }


def _select_valid(data: Bytes, field: FieldDescriptor, found: list[FieldSpans]) -> list[FieldSpans]:
    """Check the wire types, and split packed runs."""
    if field.is_repeated:
        return _expand_packed(data, field, found)
    for span in found:
        _check_wire_type(field, span.wire, packed=False)
    return found


def _decode_struct(
    data: Bytes, start: Ints, end: Ints, kind: Descriptor, absent: NDArray[np.bool_] | None
) -> pa.Array:
    if _count_columns(kind) > limits.VARIABLES and not kind.GetOptions().map_entry:
        return _decode_to_json(data, start, end, kind, absent)
    columns = _decode_fields(data, start, end, list_columns(kind))
    if not columns:
        mask = None if absent is None else to_arrow(~absent).buffers()[1]
        return pa.Array.from_buffers(pa.struct([]), len(start), [mask])
    mask = None if absent is None else to_arrow(absent)
    return pa.StructArray.from_arrays(list(columns.values()), list(columns), mask=mask)


@lru_cache(maxsize=1024)
def _count_columns(kind: Descriptor) -> float:
    """Return the number of values of a message type; infinity if it contains itself."""
    counts: dict[Descriptor, float] = {}

    def count(inner: Descriptor, depth: int) -> float:
        if inner not in counts:
            counts[inner] = float("inf")  # until its fields are counted: it would contain itself
            if depth < wire_format.MAX_DEPTH:
                fields = [f.message_type for f in list_columns(inner).values()]
                counts[inner] = sum(1 if f is None else count(f, depth + 1) for f in fields)
        return counts[inner]

    return count(kind, 0)


def _decode_to_json(
    data: Bytes, start: Ints, end: Ints, kind: Descriptor, absent: NDArray[np.bool_] | None
) -> pa.Array:
    """Decode messages to JSON text, one by one."""
    name, most = kind.full_name, limits.VARIABLES
    say_once(f"{name} contains itself, or has over {most} fields: its column is JSON text")
    build = GetMessageClass(kind)
    rows: list[str | None] = []
    for k, (first, last) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        if absent is not None and absent[k]:
            rows.append(None)
            continue
        rows.append(_to_json(_parse(build, data, first, last), kind))
    return pa.array(rows, pa.string())


def _to_json(message: Any, kind: Descriptor) -> str:
    """Return a message as JSON; as a text in protobuf's format where JSON cannot express it."""
    try:
        return json_format.MessageToJson(
            message, preserving_proto_field_name=True, indent=None, descriptor_pool=kind.file.pool
        )
    except (ValueError, TypeError, KeyError, json_format.Error):
        return json.dumps(text_format.MessageToString(message, as_one_line=True))


def _decode_field(
    data: Bytes, count: int, found: list[FieldSpans], field: FieldDescriptor
) -> pa.Array:
    """Decode one field of all messages, in row order."""
    if field.is_repeated:
        row = wire_format.concatenate_spans(s.row for s in found)
        order = np.argsort(row, kind="stable")
        offsets = np.zeros(count + 1, np.int32)
        np.cumsum(np.bincount(row, minlength=count), out=offsets[1:])
        start = wire_format.concatenate_spans(s.start for s in found)[order]
        end = wire_format.concatenate_spans(s.end for s in found)[order]
        values = _decode_values(data, start, end, None, field)
        return pa.ListArray.from_arrays(to_arrow(offsets), values)
    # The last scalar wins, as the specification requires. Absent: an empty span.
    start, end = np.zeros(count, np.int64), np.zeros(count, np.int64)
    present = np.zeros(count, np.bool_)
    for span in found:
        start[span.row], end[span.row], present[span.row] = span.start, span.end, True
    occurrences = sum(len(span.row) for span in found)
    if field.message_type is not None and occurrences > np.count_nonzero(present):
        raise _RepeatedError
    return _decode_values(data, start, end, present, field)


def _check_wire_type(field: FieldDescriptor, wire: int, *, packed: bool) -> None:
    expected = wire_format.find_wire_type(field)
    if wire != expected and not (packed and wire == wire_format.DELIMITED):
        raise WireError(f"{field.full_name} has wire type {wire}, not {expected}")


def _expand_packed(
    data: Bytes, field: FieldDescriptor, found: list[FieldSpans]
) -> list[FieldSpans]:
    """Split packed runs into spans of single values."""
    scalar = field.type in wire_format.FIXED_DTYPES or field.type in wire_format.VARINT_DTYPES
    out = []
    for span in found:
        _check_wire_type(field, span.wire, packed=scalar)
        if not (scalar and span.wire == wire_format.DELIMITED):
            out.append(span)
        elif field.type in wire_format.FIXED_DTYPES:
            size = np.dtype(wire_format.FIXED_DTYPES[field.type]).itemsize
            if ((span.end - span.start) % size).any():
                raise WireError(f"{field.full_name} is cut within a value")
            start, row = _expand_runs(span, size)
            out.append(FieldSpans(row, wire_format.VARINT, start, start + size))
        else:
            byte, row = _expand_runs(span, 1)
            last = data[byte] < 0x80
            first = np.concatenate([[True], last[:-1]])[: len(last)]
            out.append(FieldSpans(row[first], wire_format.VARINT, byte[first], byte[last] + 1))
    return out


def _expand_runs(span: FieldSpans, size: int) -> tuple[Ints, Ints]:
    """Return offset and row of every value of ``size`` bytes in some spans."""
    counts = (span.end - span.start) // size
    index = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(span.start, counts) + index * size, np.repeat(span.row, counts)


def _decode_values(
    data: Bytes, start: Ints, end: Ints, present: NDArray[np.bool_] | None, field: FieldDescriptor
) -> pa.Array:
    """Decode the values in some spans; use the field's default where ``present`` is false."""
    if field.message_type is not None:
        absent = None if present is None or present.all() else ~present
        return _decode_struct(data, start, end, field.message_type, absent)
    default = None if field.is_repeated else field.default_value
    if field.type in wire_format.FIXED_DTYPES:
        dtype = np.dtype(wire_format.FIXED_DTYPES[field.type])
        return to_arrow(
            wire_format.decode_present(
                present, start, lambda at: wire_format.decode_fixed(data, at, dtype), dtype, default
            )
        )
    if field.type in wire_format.VARINT_DTYPES:
        dtype = np.dtype(wire_format.VARINT_DTYPES[field.type])
        zigzag = field.type in (F.TYPE_SINT32, F.TYPE_SINT64)
        values = wire_format.decode_present(
            present,
            start,
            lambda at: wire_format.decode_integers(data, at, dtype, zigzag),
            dtype,
            default,
        )
        return to_arrow(values)
    return _decode_texts(data, start, end, present, field)


def _decode_texts(
    data: Bytes, start: Ints, end: Ints, present: NDArray[np.bool_] | None, field: FieldDescriptor
) -> pa.Array:
    kind = pa.string() if field.type == F.TYPE_STRING else pa.binary()
    try:
        texts = wire_format.decode_strings(data, start, end, kind)
    except UnicodeDecodeError:
        features = getattr(field, "_GetFeatures", lambda: None)()
        if getattr(features, "utf8_validation", 0) != WITHOUT_UTF8_CHECK:
            raise WireError("a text is not UTF-8") from None
        held = wire_format.decode_strings(data, start, end, pa.binary()).to_pylist()
        texts = pa.array([value.decode(errors="backslashreplace") for value in held], kind)
    if present is None or not field.default_value or present.all():
        return texts
    return pc.if_else(to_arrow(present), texts, pa.scalar(field.default_value, kind))
