"""A topic of a recording as an object: its messages as a table."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl.export.tables import flat
from dmrl.recording import (
    read_table,
)

if TYPE_CHECKING:
    import pandas as pd

    from dmrl.api.recordings import Recording


class Topic:
    """One topic of a recording, as a table whose rows are its messages in log-time order.

    Parameters
    ----------
    recording
        Where it stands.
    name
        Of the topic.
    """

    def __init__(self, recording: "Recording", name: str) -> None:
        self.recording, self.name = recording, name
        self._info = recording.topics[name]

    @property
    def schema(self) -> str:
        """Full name of its message type."""
        return self._info.schema

    def __len__(self) -> int:
        """Messages on it."""
        return self._info.count

    def to_arrow(
        self,
        *,
        fields: Sequence[str] | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> pa.Table:
        """An Arrow table with a column for each field of the message.

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
            within is a struct, a repeated field a list, an enum an int32.

        Raises
        ------
        RecordingError
            If the recording is damaged.
        """
        start_ns, end_ns = self.recording.log_time(start_s), self.recording.log_time(end_s)
        path = self.recording.path
        return read_table(path, self.name, fields=fields, start_ns=start_ns, end_ns=end_ns)

    def to_pandas(
        self,
        *,
        fields: Sequence[str] | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> "pd.DataFrame":
        """A data frame over ``time_s``, seconds from the start of the recording.

        Fields of a message within are columns of their own, ``pose.position.x``; of a list of
        messages, such as the peers of PeerLabels, each is a row.

        Raises
        ------
        MissingExtra
            If pandas is not installed.
        RecordingError
            If the recording is damaged.
        """
        table = flat(self.to_arrow(fields=fields, start_s=start_s, end_s=end_s))
        return self.recording.framed(table)

    def to_numpy(
        self,
        *,
        fields: Sequence[str] | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> NDArray[np.void]:
        """(N,) structured array: ``array["height_m"]`` is a field of all messages.

        Texts, bytes and lists are objects.
        """
        table = flat(self.to_arrow(fields=fields, start_s=start_s, end_s=end_s))
        columns = {name: table[name].to_numpy() for name in table.column_names}
        out = np.empty(table.num_rows, [(name, c.dtype) for name, c in columns.items()])
        for name, column in columns.items():
            out[name] = column
        return out

    def __repr__(self) -> str:
        return f"<{self.name}: {len(self)} messages of {self.schema}>"
