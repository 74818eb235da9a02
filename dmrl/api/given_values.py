"""Values that a caller gives to a writer: times, columns and fields, checked.

NumPy changes some on the way to an array, without a word: it drops zero bytes at the end of texts
and bytes, and shows what is below a mask.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from numpy.typing import ArrayLike, NDArray

from dmrl.errors import RecordingError, SettingError
from dmrl.samples.flight import LATEST_TIME_S

TEXT_TYPES = (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)


def to_log_times(
    place: str, time_s: ArrayLike | None, time_ns: ArrayLike | None
) -> NDArray[np.int64]:
    """Return (N,) log times, nanoseconds, of seconds or of nanoseconds.

    Parameters
    ----------
    place
        File and topic, for the error.
    time_s, time_ns
        (N,) one of them; the other is None.

    Raises
    ------
    SettingError
        If both are None, or none is.
    RecordingError
        If a time is no number, or one that no recording has.
    """
    if (time_s is None) == (time_ns is None):
        raise SettingError(f"{place} has no time, or two. Give time_s or time_ns")
    given, kinds, latest, words = time_s, "biuf", LATEST_TIME_S, ("seconds", "s", "numbers")
    if time_s is None:
        latest = int(LATEST_TIME_S) * 10**9
        given, kinds, words = time_ns, "iu", ("nanoseconds", "ns", "integers")
    times = np.asarray(given)
    wrong = times.ndim != 1 or np.ma.is_masked(given)
    if wrong or (times.size and times.dtype.kind not in kinds):
        raise RecordingError(f"{place} at {given!r:.80}. Give {words[0]} as {words[2]}")
    fits = (times >= 0) & (times < latest)
    if not fits.all():
        raise RecordingError(
            f"{place} at {times[~fits][0]:g} {words[1]}. Give {words[0]} from 0 to {latest:g}"
        )
    return (times if time_s is None else np.rint(times.astype(float) * 1e9)).astype(np.int64)


def to_column(topic: str, name: str, values: ArrayLike) -> NDArray[Any]:
    """Return the values of a field as an array along times; texts and unlike lists as objects.

    Raises
    ------
    SettingError
        If there is one value only, some are masked, or NumPy has shortened them.
    """
    if np.ma.is_masked(values):
        raise SettingError(f"{topic}: {name} has masked values. Leave out their times")
    try:
        column = np.asarray(values)
    except ValueError:
        column = np.fromiter(iter(values), object)  # type: ignore[arg-type]
    if not column.ndim:
        raise SettingError(f"{topic}: one value of {name} at several times. Give one for each")
    if column.dtype.kind == "S" and isinstance(values, np.ndarray):
        raise SettingError(
            f"{topic}: {name} is an array of bytes, of which NumPy drops zeros at the end. "
            "Give a list of bytes"
        )
    return np.fromiter(iter(values), object) if column.dtype.kind in "SU" else column  # type: ignore[arg-type]


def is_plain(kind: Descriptor, name: str, column: NDArray[Any]) -> bool:
    """Return whether a column can be encoded as a whole: numbers, or a text for each message."""
    field = kind.fields_by_name.get(name)
    if field is None or field.is_repeated or column.ndim > 1 or field.type not in TEXT_TYPES:
        return column.dtype.kind in "biuf"
    return True


def require_values(kind: Any, fields: Mapping[str, Any]) -> None:
    """Raise ValueError if protobuf would store something else than was given.

    It stores None and masked numbers as 0, and a text for a list letter by letter.
    """
    for name, value in fields.items():
        field = kind.fields_by_name.get(name)
        if field is None:
            continue  # the message itself refuses it
        if field.is_repeated and isinstance(value, str | bytes):
            raise ValueError(f"{name} is a list: [{value!r:.40}]")
        absent = value is None and not field.is_repeated and not field.has_presence
        if absent or np.ma.is_masked(value):
            raise ValueError(f"{name} has no value")
        if field.message_type is not None:
            for one in value if field.is_repeated and value else [value]:
                if isinstance(one, Mapping):
                    require_values(field.message_type, one)
