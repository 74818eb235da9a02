"""Decode protobuf messages to Arrow columns, thousands at a time.

The wire format is decoded field by field over all messages of a batch at once. Every round
reads the next tag of every message, groups the messages by tag, and skips the values. A batch
of messages of one layout (nearly every sensor topic) takes a few NumPy calls per field.
Source: Protocol Buffers encoding specification.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from numpy.typing import NDArray

from dmrl.recording.mcap.message_batch import Bytes, Ints
from dmrl.recording.protobuf.wire_values import (
    FIXED_DTYPES,
    VARINT_DTYPES,
    WireError,
    decode_fixed,
    decode_integers,
    decode_present,
    decode_strings,
    decode_varints,
)

VARINT, FIXED64, DELIMITED, FIXED32 = 0, 1, 2, 5
F = FieldDescriptor


@dataclass(frozen=True, slots=True)
class FieldSpans:
    """Occurrences of one field: row and byte range of each value.

    For varints ``start`` is the first byte of the value, for delimited values that of the payload.
    """

    row: Ints
    wire: int
    start: Ints
    end: Ints


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
        (N,) each, in schema order. An absent field has its protobuf default; an absent
        sub-message is null. Repeated fields are lists, enums int32.

    Raises
    ------
    WireError
        If the bytes do not conform to the wire format or the type.
    """
    wanted = [f for f in descriptor.fields if fields is None or f.name in fields]
    return _decode_fields(data, start, end, wanted, (descriptor.full_name,)) if wanted else {}


def _decode_fields(
    data: Bytes,
    start: Ints,
    end: Ints,
    fields: Sequence[FieldDescriptor],
    within: tuple[str, ...],
) -> dict[str, pa.Array]:
    found = _find_fields(data, start, end, {f.number for f in fields})
    return {
        f.name: _decode_field(data, len(start), found.get(f.number, []), f, within) for f in fields
    }


def _decode_struct(
    data: Bytes,
    start: Ints,
    end: Ints,
    kind: Descriptor,
    within: tuple[str, ...],
    absent: NDArray[np.bool_] | None,
) -> pa.StructArray:
    if kind.full_name in within:
        raise WireError(f"{kind.full_name} contains itself")
    if not kind.fields:
        return pa.nulls(len(start), pa.struct([]))
    columns = _decode_fields(data, start, end, kind.fields, (*within, kind.full_name))
    mask = None if absent is None else pa.array(absent)
    return pa.StructArray.from_arrays(list(columns.values()), list(columns), mask=mask)


def _find_fields(
    data: Bytes, start: Ints, end: Ints, wanted: set[int]
) -> dict[int, list[FieldSpans]]:
    """Find the wanted fields of every message, in wire order within a message."""
    found: dict[int, list[FieldSpans]] = {}
    row, at, end = np.arange(len(start)), start.copy(), np.asarray(end)
    while True:
        going = at < end
        if not going.all():
            if (at > end).any():
                raise WireError("a value runs beyond its message")
            row, at, end = row[going], at[going], end[going]
        if not len(row):
            return found
        tag, at = decode_varints(data, at)
        if (tag == tag[0]).all():
            at = _record_field(data, int(tag[0]), row, at, wanted, found)
            continue
        for one in np.unique(tag):
            these = np.flatnonzero(tag == one)
            at[these] = _record_field(data, int(one), row[these], at[these], wanted, found)


def _record_field(
    data: Bytes, tag: int, row: Ints, at: Ints, wanted: set[int], found: dict[int, list[FieldSpans]]
) -> Ints:
    """Record one field of some messages; return the offset of each message's next field."""
    number, wire = tag >> 3, tag & 7
    first = at
    if wire == VARINT:
        _, at = decode_varints(data, at)
    elif wire == FIXED64:
        at = at + 8
    elif wire == FIXED32:
        at = at + 4
    elif wire == DELIMITED:
        size, first = decode_varints(data, at)
        at = first + size.astype(np.int64)
        if (at < first).any():
            raise WireError("a length is negative")
    else:
        raise WireError(f"field {number} has wire type {wire}, which protobuf 3 does not write")
    if number in wanted:
        found.setdefault(number, []).append(FieldSpans(row, wire, first, at))
    return at


def _decode_field(
    data: Bytes,
    count: int,
    found: list[FieldSpans],
    field: FieldDescriptor,
    within: tuple[str, ...],
) -> pa.Array:
    """Decode one field of all messages, in row order."""
    if field.is_repeated:
        spans = _expand_packed(data, field, found)
        row = _concatenate(s.row for s in spans)
        order = np.argsort(row, kind="stable")
        offsets = np.zeros(count + 1, np.int32)
        np.cumsum(np.bincount(row, minlength=count), out=offsets[1:])
        start, end = (
            _concatenate(s.start for s in spans)[order],
            _concatenate(s.end for s in spans)[order],
        )
        values = _decode_values(data, start, end, None, field, within)
        return pa.ListArray.from_arrays(pa.array(offsets), values)
    # The last scalar wins, as the specification requires. Absent: an empty span.
    start, end = np.zeros(count, np.int64), np.zeros(count, np.int64)
    present = np.zeros(count, np.bool_)
    for span in found:
        _check_wire_type(field, span.wire, packed=False)
        start[span.row], end[span.row], present[span.row] = span.start, span.end, True
    return _decode_values(data, start, end, present, field, within)


def _concatenate(parts: Iterable[Ints]) -> Ints:
    return np.concatenate([np.empty(0, np.int64), *parts])


def _check_wire_type(field: FieldDescriptor, wire: int, *, packed: bool) -> None:
    if field.type in VARINT_DTYPES:
        expected = VARINT
    elif field.type in FIXED_DTYPES:
        expected = FIXED64 if np.dtype(FIXED_DTYPES[field.type]).itemsize == 8 else FIXED32
    else:
        expected = DELIMITED
    if wire != expected and not (packed and wire == DELIMITED):
        raise WireError(f"{field.full_name} has wire type {wire}, not {expected}")


def _expand_packed(
    data: Bytes, field: FieldDescriptor, found: list[FieldSpans]
) -> list[FieldSpans]:
    """Split packed runs into spans of single values."""
    scalar = field.type in FIXED_DTYPES or field.type in VARINT_DTYPES
    out = []
    for span in found:
        _check_wire_type(field, span.wire, packed=scalar)
        if not (scalar and span.wire == DELIMITED):
            out.append(span)
        elif field.type in FIXED_DTYPES:
            size = np.dtype(FIXED_DTYPES[field.type]).itemsize
            if ((span.end - span.start) % size).any():
                raise WireError(f"{field.full_name} is cut within a value")
            start, row = _expand_runs(span, size)
            out.append(FieldSpans(row, VARINT, start, start + size))
        else:
            byte, row = _expand_runs(span, 1)
            last = data[byte] < 0x80
            first = np.concatenate([[True], last[:-1]])[: len(last)]
            out.append(FieldSpans(row[first], VARINT, byte[first], byte[last] + 1))
    return out


def _expand_runs(span: FieldSpans, size: int) -> tuple[Ints, Ints]:
    """Return offset and row of every value of ``size`` bytes in some spans."""
    counts = (span.end - span.start) // size
    index = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(span.start, counts) + index * size, np.repeat(span.row, counts)


def _decode_values(
    data: Bytes,
    start: Ints,
    end: Ints,
    present: NDArray[np.bool_] | None,
    field: FieldDescriptor,
    within: tuple[str, ...],
) -> pa.Array:
    """Decode the values in some spans; use the field's default where ``present`` is false."""
    if field.type in FIXED_DTYPES:
        dtype = np.dtype(FIXED_DTYPES[field.type])
        return pa.array(
            decode_present(present, start, lambda at: decode_fixed(data, at, dtype), dtype)
        )
    if field.type in VARINT_DTYPES:
        dtype, zigzag = (
            np.dtype(VARINT_DTYPES[field.type]),
            field.type in (F.TYPE_SINT32, F.TYPE_SINT64),
        )
        values = decode_present(
            present, start, lambda at: decode_integers(data, at, dtype, zigzag), dtype
        )
        return pa.array(values)
    if field.type in (F.TYPE_STRING, F.TYPE_BYTES):
        return decode_strings(
            data, start, end, pa.string() if field.type == F.TYPE_STRING else pa.binary()
        )
    if field.message_type is None:
        raise WireError(f"{field.full_name} has a type that protobuf 3 does not write")
    absent = None if present is None or present.all() else ~present
    return _decode_struct(data, start, end, field.message_type, within, absent)
