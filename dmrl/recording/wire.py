"""Protobuf messages to Arrow columns, thousands at a time.

The wire format is decoded field by field over all messages of a block at once: every round
reads the next tag of every message, groups messages by tag, and steps over the values. A
block of equal-looking messages (nearly every sensor topic) costs a few NumPy calls a field.
Source: Protocol Buffers encoding specification.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

VARINT, FIXED64, DELIMITED, FIXED32 = 0, 1, 2, 5
# Below this mean size one gather of all bytes beats a slice per value.
GATHER_BYTES = 64

F = FieldDescriptor
FIXED = {
    F.TYPE_DOUBLE: "<f8",
    F.TYPE_FLOAT: "<f4",
    F.TYPE_FIXED64: "<u8",
    F.TYPE_SFIXED64: "<i8",
    F.TYPE_FIXED32: "<u4",
    F.TYPE_SFIXED32: "<i4",
}
VARINTS = {
    F.TYPE_INT64: "i8",
    F.TYPE_UINT64: "u8",
    F.TYPE_INT32: "i4",
    F.TYPE_UINT32: "u4",
    F.TYPE_ENUM: "i4",
    F.TYPE_BOOL: "?",
    F.TYPE_SINT32: "i4",
    F.TYPE_SINT64: "i8",
}


class WireError(ValueError):
    """The bytes are not messages of the type they are said to be."""


@dataclass(frozen=True, slots=True)
class Found:
    """Values of one field: the row each belongs to and where it lies.

    For varints ``start`` is the value's first byte; for delimited values the payload.
    """

    row: Ints
    wire: int
    start: Ints
    end: Ints


def decode(
    data: Bytes, start: Ints, end: Ints, descriptor: Descriptor, fields: Sequence[str] | None = None
) -> dict[str, pa.Array]:
    """Messages as Arrow columns, one per field, by name.

    Parameters
    ----------
    data
        Bytes that hold the messages.
    start, end
        (N,) where each message lies in ``data``.
    descriptor
        Their type.
    fields
        Only these. None: all.

    Returns
    -------
    dict[str, pa.Array]
        (N,) each, in the order of the schema. A field that a message lacks has its default,
        as protobuf has it; an absent sub-message is null. Repeated fields are lists, enums int32.

    Raises
    ------
    WireError
        If the bytes do not follow the wire format or the type.
    """
    wanted = [f for f in descriptor.fields if fields is None or f.name in fields]
    return _columns(data, start, end, wanted, (descriptor.full_name,)) if wanted else {}


def _columns(
    data: Bytes,
    start: Ints,
    end: Ints,
    fields: Sequence[FieldDescriptor],
    within: tuple[str, ...],
) -> dict[str, pa.Array]:
    found = _scan(data, start, end, {f.number for f in fields})
    return {f.name: _column(data, len(start), found.get(f.number, []), f, within) for f in fields}


def _struct(
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
    columns = _columns(data, start, end, kind.fields, (*within, kind.full_name))
    mask = None if absent is None else pa.array(absent)
    return pa.StructArray.from_arrays(list(columns.values()), list(columns), mask=mask)


def _scan(data: Bytes, start: Ints, end: Ints, wanted: set[int]) -> dict[int, list[Found]]:
    """Where the wanted fields of every message lie, in wire order within a message."""
    found: dict[int, list[Found]] = {}
    row, at, end = np.arange(len(start)), start.copy(), np.asarray(end)
    while True:
        going = at < end
        if not going.all():
            if (at > end).any():
                raise WireError("a value runs beyond its message")
            row, at, end = row[going], at[going], end[going]
        if not len(row):
            return found
        tag, at = _varint(data, at)
        if (tag == tag[0]).all():
            at = _step(data, int(tag[0]), row, at, wanted, found)
            continue
        for one in np.unique(tag):
            these = np.flatnonzero(tag == one)
            at[these] = _step(data, int(one), row[these], at[these], wanted, found)


def _step(
    data: Bytes, tag: int, row: Ints, at: Ints, wanted: set[int], found: dict[int, list[Found]]
) -> Ints:
    """Note one field of some messages; where the next field of each begins."""
    number, wire = tag >> 3, tag & 7
    first = at
    if wire == VARINT:
        _, at = _varint(data, at)
    elif wire == FIXED64:
        at = at + 8
    elif wire == FIXED32:
        at = at + 4
    elif wire == DELIMITED:
        size, first = _varint(data, at)
        at = first + size.astype(np.int64)
        if (at < first).any():
            raise WireError("a length is negative")
    else:
        raise WireError(f"field {number} has wire type {wire}, which protobuf 3 does not write")
    if number in wanted:
        found.setdefault(number, []).append(Found(row, wire, first, at))
    return at


def _varint(data: Bytes, at: Ints) -> tuple[NDArray[np.uint64], Ints]:
    """Value of the varint at each offset, and the offset after it."""
    try:
        byte = data[at]
    except IndexError:
        raise WireError("a value runs beyond its message") from None
    value = (byte & 0x7F).astype(np.uint64)
    at = at + 1
    more = np.flatnonzero(byte & 0x80)
    shift = 7
    while len(more):
        if shift > 63:
            raise WireError("a varint is longer than ten bytes")
        try:
            byte = data[at[more]]
        except IndexError:
            raise WireError("a value runs beyond its message") from None
        value[more] |= (byte & 0x7F).astype(np.uint64) << np.uint64(shift)
        at[more] += 1
        more = more[(byte & 0x80) != 0]
        shift += 7
    return value, at


def _column(
    data: Bytes, count: int, found: list[Found], field: FieldDescriptor, within: tuple[str, ...]
) -> pa.Array:
    """One field of all messages, in row order."""
    values = _values_of(field, within)
    if field.is_repeated:
        spans = _expand_packed(data, field, found)
        row = _joined(s.row for s in spans)
        order = np.argsort(row, kind="stable")
        offsets = np.zeros(count + 1, np.int32)
        np.cumsum(np.bincount(row, minlength=count), out=offsets[1:])
        start, end = _joined(s.start for s in spans)[order], _joined(s.end for s in spans)[order]
        return pa.ListArray.from_arrays(pa.array(offsets), values(data, start, end, None))
    # Last one wins, as the specification says of scalars. Absent: an empty span.
    start, end = np.zeros(count, np.int64), np.zeros(count, np.int64)
    present = np.zeros(count, np.bool_)
    for span in found:
        _expect(field, span.wire, packed=False)
        start[span.row], end[span.row], present[span.row] = span.start, span.end, True
    return values(data, start, end, present)


def _joined(parts: Iterable[Ints]) -> Ints:
    return np.concatenate([np.empty(0, np.int64), *parts])


def _expect(field: FieldDescriptor, wire: int, *, packed: bool) -> None:
    if field.type in VARINTS:
        own = VARINT
    elif field.type in FIXED:
        own = FIXED64 if np.dtype(FIXED[field.type]).itemsize == 8 else FIXED32
    else:
        own = DELIMITED
    if wire != own and not (packed and wire == DELIMITED):
        raise WireError(f"{field.full_name} has wire type {wire}, not {own}")


def _expand_packed(data: Bytes, field: FieldDescriptor, found: list[Found]) -> list[Found]:
    """Spans of single values, packed runs taken apart."""
    scalar = field.type in FIXED or field.type in VARINTS
    out = []
    for span in found:
        _expect(field, span.wire, packed=scalar)
        if not (scalar and span.wire == DELIMITED):
            out.append(span)
        elif field.type in FIXED:
            size = np.dtype(FIXED[field.type]).itemsize
            if ((span.end - span.start) % size).any():
                raise WireError(f"{field.full_name} is cut within a value")
            start, row = _runs(span, size)
            out.append(Found(row, VARINT, start, start + size))
        else:
            byte, row = _runs(span, 1)
            last = data[byte] < 0x80
            first = np.concatenate([[True], last[:-1]])[: len(last)]
            out.append(Found(row[first], VARINT, byte[first], byte[last] + 1))
    return out


def _runs(span: Found, size: int) -> tuple[Ints, Ints]:
    """Offset and row of every value of ``size`` bytes in some spans."""
    counts = (span.end - span.start) // size
    index = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(span.start, counts) + index * size, np.repeat(span.row, counts)


Values = Callable[[Bytes, Ints, Ints, NDArray[np.bool_] | None], pa.Array]


def _values_of(field: FieldDescriptor, within: tuple[str, ...]) -> Values:
    """The function that turns spans of this field's type into an Arrow array."""
    if field.type in FIXED:
        dtype = np.dtype(FIXED[field.type])

        def fixed(
            data: Bytes, start: Ints, end: Ints, present: NDArray[np.bool_] | None
        ) -> pa.Array:
            return pa.array(
                _unless_absent(present, start, lambda at: _fixed(data, at, dtype), dtype)
            )

        return fixed
    if field.type in VARINTS:
        kind, zigzag = np.dtype(VARINTS[field.type]), field.type in (F.TYPE_SINT32, F.TYPE_SINT64)

        def varint(
            data: Bytes, start: Ints, end: Ints, present: NDArray[np.bool_] | None
        ) -> pa.Array:
            return pa.array(
                _unless_absent(present, start, lambda at: _integers(data, at, kind, zigzag), kind)
            )

        return varint
    if field.type in (F.TYPE_STRING, F.TYPE_BYTES):
        kind_of = pa.string() if field.type == F.TYPE_STRING else pa.binary()
        return lambda data, start, end, _: _text(data, start, end, kind_of)
    if (kind_of_message := field.message_type) is not None:

        def message(
            data: Bytes, start: Ints, end: Ints, present: NDArray[np.bool_] | None
        ) -> pa.Array:
            absent = None if present is None or present.all() else ~present
            return _struct(data, start, end, kind_of_message, within, absent)

        return message
    raise WireError(f"{field.full_name} has a type that protobuf 3 does not write")


def _unless_absent(
    present: NDArray[np.bool_] | None,
    start: Ints,
    read: Callable[[Ints], NDArray[np.generic]],
    dtype: np.dtype[np.generic],
) -> NDArray[np.generic]:
    """Values read at ``start``; zero where absent."""
    if present is None or present.all():
        return read(start)
    out = np.zeros(len(start), dtype.newbyteorder("="))
    out[present] = read(start[present])
    return out


def _fixed(data: Bytes, at: Ints, dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    # A view with a stride of one byte reads unaligned values in one gather.
    view = np.ndarray((max(len(data) - dtype.itemsize + 1, 0),), dtype, data, 0, (1,))
    try:
        return np.ascontiguousarray(view[at])
    except IndexError:
        raise WireError("a value runs beyond its message") from None


def _integers(
    data: Bytes, at: Ints, dtype: np.dtype[np.generic], zigzag: bool
) -> NDArray[np.generic]:
    value, _ = _varint(data, at)
    if zigzag:
        value = (value >> np.uint64(1)) ^ (np.uint64(0) - (value & np.uint64(1)))
    return value.astype(np.bool_) if dtype == np.bool_ else value.view(np.int64).astype(dtype)


def _text(data: Bytes, start: Ints, end: Ints, kind: pa.DataType) -> pa.Array:
    size = end - start
    offsets = np.zeros(len(size) + 1, np.int64)
    np.cumsum(size, out=offsets[1:])
    if offsets[-1] > np.iinfo(np.int32).max:
        raise WireError("more than 2 GiB of text in one block")
    if len(size) and offsets[-1] > GATHER_BYTES * len(size):
        view = data.data
        body = b"".join(view[a:b] for a, b in zip(start.tolist(), end.tolist(), strict=True))
    else:
        index = np.arange(offsets[-1]) + np.repeat(start - offsets[:-1], size)
        body = data[index].tobytes()
    buffers = [None, pa.py_buffer(offsets.astype(np.int32)), pa.py_buffer(body)]
    return pa.Array.from_buffers(kind, len(size), buffers)
