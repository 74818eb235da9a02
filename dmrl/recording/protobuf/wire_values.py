"""Read values in protobuf's wire format at many offsets of a byte array at once."""

from collections.abc import Callable

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor import FieldDescriptor
from numpy.typing import NDArray

from dmrl.recording.mcap.message_batch import Bytes, Ints

GATHER_BYTES = 64
"""Mean size of a text below which one gather of all bytes is faster than a slice per text."""

F = FieldDescriptor
FIXED_DTYPES = {
    F.TYPE_DOUBLE: "<f8",
    F.TYPE_FLOAT: "<f4",
    F.TYPE_FIXED64: "<u8",
    F.TYPE_SFIXED64: "<i8",
    F.TYPE_FIXED32: "<u4",
    F.TYPE_SFIXED32: "<i4",
}
VARINT_DTYPES = {
    F.TYPE_INT64: "i8",
    F.TYPE_UINT64: "u8",
    F.TYPE_INT32: "i4",
    F.TYPE_UINT32: "u4",
    F.TYPE_ENUM: "i4",
    F.TYPE_BOOL: "?",
    F.TYPE_SINT32: "i4",
    F.TYPE_SINT64: "i8",
}


VARINT, FIXED64, DELIMITED, START_GROUP, END_GROUP, FIXED32 = range(6)


def find_wire_type(field: FieldDescriptor) -> int:
    """Return the wire type of a field's values, where they are not packed."""
    if field.type in VARINT_DTYPES:
        return VARINT
    if field.type in FIXED_DTYPES:
        return FIXED64 if np.dtype(FIXED_DTYPES[field.type]).itemsize == 8 else FIXED32
    return START_GROUP if field.type == F.TYPE_GROUP else DELIMITED


class WireError(ValueError):
    """The bytes are not messages of the given type."""


def decode_varints(data: Bytes, at: Ints) -> tuple[NDArray[np.uint64], Ints]:
    """Read the varint at each offset; return values and the offsets after them."""
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


def decode_present(
    present: NDArray[np.bool_] | None,
    start: Ints,
    read: Callable[[Ints], NDArray[np.generic]],
    dtype: np.dtype[np.generic],
    default: float | None = None,
) -> NDArray[np.generic]:
    """Read the values at ``start``; return the default, or zero, for those that are absent."""
    if present is None or present.all():
        return read(start)
    out = np.full(len(start), default or 0, dtype.newbyteorder("="))
    out[present] = read(start[present])
    return out


def decode_fixed(data: Bytes, at: Ints, dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    """Read (N,) values of fixed size.

    Raises
    ------
    WireError
        If a value reaches beyond the data.
    """
    # A view with a stride of one byte reads unaligned values in one gather.
    view = np.ndarray((max(len(data) - dtype.itemsize + 1, 0),), dtype, data, 0, (1,))
    try:
        return np.ascontiguousarray(view[at])
    except IndexError:
        raise WireError("a value runs beyond its message") from None


def decode_integers(
    data: Bytes, at: Ints, dtype: np.dtype[np.generic], zigzag: bool
) -> NDArray[np.generic]:
    """Read (N,) integers, enums or booleans, stored as varints."""
    value, _ = decode_varints(data, at)
    if zigzag:
        if dtype.itemsize == 4:  # a longer varint is cut first, then decoded
            value &= np.uint64(0xFFFFFFFF)
        value = (value >> np.uint64(1)) ^ (np.uint64(0) - (value & np.uint64(1)))
    return value.astype(np.bool_) if dtype == np.bool_ else value.view(np.int64).astype(dtype)


def decode_strings(data: Bytes, start: Ints, end: Ints, kind: pa.DataType) -> pa.Array:
    """Read (N,) strings or bytes from spans.

    Raises
    ------
    WireError
        If a batch has more than 2 GiB of text.
    UnicodeDecodeError
        If a string is not UTF-8.
    """
    size = end - start
    offsets = np.zeros(len(size) + 1, np.int64)
    np.cumsum(size, out=offsets[1:])
    if offsets[-1] > np.iinfo(np.int32).max:
        raise WireError("more than 2 GiB of text in one batch")
    if len(size) and offsets[-1] > GATHER_BYTES * len(size):
        view = data.data
        body = b"".join(view[a:b] for a, b in zip(start.tolist(), end.tolist(), strict=True))
    else:
        index = np.arange(offsets[-1]) + np.repeat(start - offsets[:-1], size)
        body = data[index].tobytes()
    buffers = [None, pa.py_buffer(offsets.astype(np.int32)), pa.py_buffer(body)]
    made = pa.Array.from_buffers(kind, len(size), buffers)
    try:
        made.validate(full=True)
    except pa.ArrowInvalid:
        raise UnicodeDecodeError("utf-8", b"", 0, 0, "in a batch of texts") from None
    return made
