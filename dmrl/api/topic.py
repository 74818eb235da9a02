"""A topic of a recording as an object: its messages as a table."""

from collections.abc import Sequence
from importlib.util import find_spec
from math import isinf, isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl.errors import MissingExtra, RecordingError, SettingError, suggest
from dmrl.exchange.csv_parquet import flatten_table
from dmrl.messages import to_status_name
from dmrl.recording import TopicInfo, read_table
from dmrl.recording.mcap.message_batch import MAX_TIME_NS

if TYPE_CHECKING:
    import pandas as pd

NULLABLE: dict[pa.DataType, Any] = {
    pa.int32(): "Int32",
    pa.uint32(): "UInt32",
    pa.int64(): "Int64",
    pa.uint64(): "UInt64",
}
"""Types of pandas for integers with absent values. A float rounds those over 2**53."""


def to_log_time(time_s: float | None, start_ns: int) -> int | None:
    """Return the log time, nanoseconds, of seconds from a start; None stays None.

    Times before 0, and later ones than a recording holds, are the first and the last there.

    Raises
    ------
    SettingError
        If the seconds are not a number.
    """
    if time_s is None:
        return None
    try:
        unknown = isnan(time_s)
    except TypeError:
        unknown = True
    if unknown:
        raise SettingError(
            f"{time_s!r:.40} is no time. Give seconds from the start of the recording, or None"
        )
    if isinf(time_s):
        return MAX_TIME_NS if time_s > 0 else 0
    return min(max(start_ns + round(time_s * 1e9), 0), MAX_TIME_NS)


def to_data_frame(table: pa.Table, start_ns: int, *, foreign: bool = False) -> "pd.DataFrame":
    """Return a table as a data frame over ``time_s``; a status of dmrl becomes its name.

    Parameters
    ----------
    table
        Table with ``log_time``, without nested messages.
    start_ns
        Log time from which seconds count, nanoseconds.
    foreign
        The messages are not of dmrl. A column ``time_s`` of theirs is renamed ``time_s_``.

    Raises
    ------
    MissingExtra
        If pandas is not installed.
    """
    if find_spec("pandas") is None:
        raise MissingExtra("pandas", "table", "a data frame")
    frame: pd.DataFrame = table.to_pandas()
    for name in _list_gappy_integers(table):
        frame[name] = np.array(table[name].to_pylist(), object)
        frame[name] = frame[name].astype(NULLABLE[table[name].type])
    if "time_s_" not in frame.columns:
        frame = frame.rename(columns={"time_s": "time_s_"})
    for name in () if foreign else frame.columns:
        if name.rpartition(".")[2] == "status":  # of an image without peers it is absent
            numbers = table[name].to_pylist()
            words = [nan if one is None else to_status_name(one) for one in numbers]
            frame[name] = np.array(words, object)
    frame.index = (frame["log_time"] - start_ns) / 1e9
    frame.index.name = "time_s"
    return frame


def _list_gappy_integers(table: pa.Table) -> list[str]:
    """Return columns with absent values among integers, which would become floats."""
    names = table.column_names
    return [name for name in names if table[name].type in NULLABLE and table[name].null_count]


class Topic:
    """One topic of a recording, as a table whose rows are its messages in log-time order.

    Parameters
    ----------
    path
        The recording.
    name
        Name of the topic.
    info
        Its message type and number of messages.
    start_ns
        Log time from which seconds count, nanoseconds.
    kept
        Object that keeps a temporary recording alive.
    """

    def __init__(
        self, path: Path, name: str, info: TopicInfo, start_ns: int, kept: object = None
    ) -> None:
        self.path, self.name = path, name
        self._info, self._start_ns, self._kept = info, start_ns, kept

    @property
    def schema(self) -> str:
        """Full name of its message type."""
        return self._info.schema

    def __len__(self) -> int:
        """Return the number of messages."""
        return self._info.count

    def to_arrow(
        self,
        *,
        fields: Sequence[str] | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> pa.Table:
        """Return an Arrow table with a column for each field of the message.

        Parameters
        ----------
        fields
            Only these. None: all.
        start_s, end_s
            Only messages in [start_s, end_s), seconds from the start of the recording.

        Returns
        -------
        pa.Table
            ``log_time`` and ``publish_time`` (int64, nanoseconds), then the fields: a message
            within is a struct, a repeated field a list, an enum an int32. A field that is named
            as a time has an underscore behind its name.

        Raises
        ------
        RecordingError
            If the recording is damaged, or its messages lack one of the fields.
        SettingError
            If a time is none.
        """
        start_ns, end_ns = to_log_time(start_s, self._start_ns), to_log_time(end_s, self._start_ns)
        wanted = [fields] if isinstance(fields, str) else fields
        table = read_table(self.path, self.name, fields=wanted, start_ns=start_ns, end_ns=end_ns)
        for name in wanted or ():
            if name not in table.column_names:
                known = read_table(self.path, self.name, end_ns=0).column_names
                remedy = suggest(name, known, f"It has: {', '.join(known)}")
                raise RecordingError(f"{self.path}: {self.name} has no field {name}. {remedy}")
        return table

    def to_pandas(
        self,
        *,
        fields: Sequence[str] | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> "pd.DataFrame":
        """Return a data frame over ``time_s``, seconds from the start of the recording.

        Fields of a message within are columns of their own, ``pose.position.x``. A message is one
        row, unless it holds a list of messages, such as the peers of PeerLabels: then each item is
        a row, and a message without items one row with empty cells. Row k has item k of every list.
        Integers with empty cells are of a nullable type of pandas, such as Int64.

        Raises
        ------
        MissingExtra
            If pandas is not installed.
        RecordingError
            If the recording is damaged.
        """
        table = flatten_table(self.to_arrow(fields=fields, start_s=start_s, end_s=end_s))
        return to_data_frame(table, self._start_ns, foreign=not self.schema.startswith("dmrl.v1."))

    def to_numpy(
        self,
        *,
        fields: Sequence[str] | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> NDArray[np.void]:
        """Return an (N,) structured array: ``array["height_m"]`` is a field of all messages.

        Its rows are those of `to_pandas`, so N is not the number of messages if these hold lists
        of messages. Texts, bytes and lists of values are objects, and so are integers of a column
        with absent ones, which are None.
        """
        table = flatten_table(self.to_arrow(fields=fields, start_s=start_s, end_s=end_s))
        columns = {name: table[name].to_numpy() for name in table.column_names}
        for name in _list_gappy_integers(table):
            columns[name] = np.array(table[name].to_pylist(), object)
        out = np.empty(table.num_rows, [(name, c.dtype) for name, c in columns.items()])
        for name, column in columns.items():
            out[name] = column
        return out

    def __repr__(self) -> str:
        return f"<{self.name}: {len(self)} messages of {self.schema}>"
