"""Decode messages of one size and layout, without looking for the fields of each.

Nearly all messages of a sensor have the same numbers, each of a fixed size, and lie at equal
distances in a chunk. Each field is then a column of bytes.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from numpy.typing import NDArray

from dmrl.recording.mcap.message_batch import Bytes, Ints
from dmrl.recording.protobuf.wire_format import FIXED32, FIXED64, FIXED_DTYPES, find_wire_type

SIZES = {FIXED64: 8, FIXED32: 4}
"""Bytes of a value, by wire type."""


def decode_equal(
    data: Bytes, start: Ints, end: Ints, fields: Mapping[str, FieldDescriptor]
) -> dict[str, NDArray[Any]] | None:
    """Decode messages that are alike; return None if they are not.

    Parameters
    ----------
    data
        Bytes that contain the messages.
    start, end
        (N,) range of each message in ``data``.
    fields
        Fields to decode, by column.

    Returns
    -------
    dict[str, NDArray] or None
        (N,) values of each field; the default of a field that no message has. None if a field has
        no fixed size, or the messages differ in anything but the values.
    """
    fixed = not any(f.is_repeated or f.type not in FIXED_DTYPES for f in fields.values())
    if not fixed or len(start) < 2 or not _are_evenly_spaced(start, end) or end[-1] > len(data):
        return None
    first, step, size = int(start[0]), int(start[1] - start[0]), int(end[0] - start[0])
    places = _find_places(data[first : first + size].tobytes())
    if places is None:
        return None
    rows = np.ndarray((len(start), size), np.uint8, data, first, (step, 1))
    if any((rows[:, at - 1] != rows[0, at - 1]).any() for _, at in places):
        return None
    # Of a field that occurs twice, the last counts.
    at_of = {tag >> 3: (tag & 7, at) for tag, at in places}
    columns = {}
    for name, field in fields.items():
        wire, at = at_of.get(field.number, (None, 0))
        dtype = np.dtype(FIXED_DTYPES[field.type])
        if wire is None:
            columns[name] = np.full(len(start), field.default_value, dtype)
        elif wire != find_wire_type(field):
            return None
        else:
            view: NDArray[Any] = np.ndarray((len(start),), dtype, data, first + at, (step,))
            columns[name] = np.ascontiguousarray(view)
    return columns


def _are_evenly_spaced(start: Ints, end: Ints) -> bool:
    """Return whether messages follow each other at one distance, and have one size."""
    step, size = start[1] - start[0], end[0] - start[0]
    return bool(0 < size <= step and (np.diff(start) == step).all() and (end - start == size).all())


def _find_places(message: bytes) -> list[tuple[int, int]] | None:
    """Return the tag of each field and the offset of its value; None if a size is not fixed."""
    places, at = [], 0
    while at < len(message):
        tag = message[at]
        if tag >= 0x80 or tag < 8 or tag & 7 not in SIZES:
            return None
        places.append((tag, at + 1))
        at += 1 + SIZES[tag & 7]
    return places if at == len(message) else None
