"""Export of every topic of a recording as a table, CSV or Parquet, and of images as files.

``/cf1/attitude`` becomes ``cf1.attitude.csv``; a dot in a topic is written ``%2E``. The first
columns are ``log_time`` and ``publish_time``, nanoseconds. A field of a sub-message is
``pose.position.x``. Each item of a list of sub-messages, such as the peers of ``PeerLabels``, is
a row; a message without items has one row with empty cells. Images are files
``cf1.camera.image/<log_time>.png``, the second of a time ``<log_time>-2.png``, and ``data``
contains their names.

In CSV, lists are JSON, other bytes are base64, and a text that a spreadsheet would run as a
formula gets an apostrophe in front. In Parquet all values keep their types.
"""

import base64
import json
from collections import Counter
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from dmrl.atomic_output import atomic_folder
from dmrl.errors import MissingExtra, RecordingError, UnreadableTopic, UnsafeName
from dmrl.guards.safe_names import safe_join, to_topic_file_name
from dmrl.recording import iter_columns, read_summary, read_table
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import track

TableFormat = Literal["csv", "parquet"]
TIME_DIGITS = 12  # as image_folder requires
_FORMULA_START = "^(['=+@\t\r\n\uff1d\uff0b\uff0d\uff20-])"
"""Texts that a spreadsheet runs (OWASP, CSV injection). The apostrophe is among them, so that
removing one from every text that begins with one restores the original.
"""


def write_tables(recording: Path, out: Path, kind: TableFormat) -> dict[str, int]:
    """Write the tables to the folder ``out``; return rows per topic.

    Parameters
    ----------
    recording
        A complete recording.
    out
        Folder to write. Must not exist.
    kind
        "csv" or "parquet".

    Raises
    ------
    MissingExtra
        If pandas, which writes CSV, is not installed.
    RecordingError
        If the recording cannot be read, or none of its topics. Topics that are not protobuf, or
        carry another type than dmrl's of that name, are left out.
    OutputError
        If ``out`` exists or cannot be written.
    """
    if kind == "csv" and find_spec("pandas") is None:
        raise MissingExtra("pandas", "table", "convert --to csv")
    found = read_summary(recording)
    counts = {}
    with atomic_folder(out) as folder:
        for topic, info in track(found.topics.items(), "Writing tables"):
            path = safe_join(
                folder, to_topic_file_name(topic), f"{recording}: a topic", suffix=f".{kind}"
            )
            try:
                if info.schema == "foxglove.CompressedImage":
                    table = _write_images(recording, topic, path.with_suffix(""))
                else:
                    table = read_table(recording, topic)
            except UnreadableTopic as e:
                leave_out(e.reason, recording, info.count)
                continue
            table = flatten_table(table)
            _check_free(path, topic)
            _write_table(table, path, kind)
            counts[topic] = table.num_rows
        if found.topics and not counts:
            raise RecordingError(
                f"{recording} has no topic that can be read. Try: dmrl info {recording}"
            )
    return counts


def _check_free(path: Path, topic: str) -> None:
    """Raise UnsafeName if two topics share a file, as on a disk that ignores case."""
    if path.exists():
        raise UnsafeName(
            f"{topic} and another topic would both become {path.name}. Remove one: dmrl trim"
        )


def _write_images(recording: Path, topic: str, folder: Path) -> pa.Table:
    """Write images to files; return the table with their names in place of their bytes."""
    _check_free(folder, topic)
    batches, seen = [], Counter[str]()
    for batch in iter_columns(recording, topic):
        folder.mkdir(exist_ok=True)  # only now, for a topic may be unreadable
        names = []
        for time_ns, kind in zip(batch["log_time"], batch["format"], strict=True):
            stem = f"{time_ns.as_py():0{TIME_DIGITS}d}"
            seen[stem] += 1
            again = f"-{seen[stem]}" if seen[stem] > 1 else ""
            names.append(f"{stem}{again}.{_image_suffix(kind.as_py())}")
        for name, data in zip(names, batch["data"], strict=True):
            (folder / name).write_bytes(data.as_buffer())
        at = batch.schema.get_field_index("data")
        paths = pa.array([f"{folder.name}/{name}" for name in names], pa.string())
        batches.append(batch.set_column(at, "data", paths))
    if not batches:
        return read_table(recording, topic)
    return pa.Table.from_batches(batches)


def _image_suffix(kind: str) -> str:
    return kind if kind in ("png", "jpeg", "webp") else "bin"


def flatten_table(table: pa.Table) -> pa.Table:
    """Convert structs to columns, and lists of structs to rows: row k has item k of each list.

    The columns of a shorter list are null in the rows after its last item. A row without items
    remains one row. Lists within items follow: the other columns are repeated beside their items.
    """
    while True:
        while any(map(pa.types.is_struct, table.schema.types)):
            table = table.flatten()
        lists = [field.name for field in table.schema if _is_struct_list(field.type)]
        if not lists:
            return table
        table = _pair_items(table, lists)


def _pair_items(table: pa.Table, lists: list[str]) -> pa.Table:
    """Return a row with item k of each list for each k, beside the other columns."""
    lengths = {
        name: pc.fill_null(pc.list_value_length(table[name]), 0).to_numpy() for name in lists
    }
    heights = np.max(list(lengths.values()), 0, initial=1)
    rows, starts = np.repeat(np.arange(len(table)), heights), heights.cumsum() - heights
    plain = table.drop_columns(lists)
    columns = dict(zip(plain.column_names, plain.take(rows).columns, strict=True))
    for name, length in lengths.items():
        of = np.repeat(np.arange(len(table)), length)
        places = np.full(len(rows), -1)
        places[starts[of] + np.arange(len(of)) - np.searchsorted(of, of)] = np.arange(len(of))
        items = pc.list_flatten(table[name].combine_chunks())
        columns[name] = items.take(pa.array(places, mask=places < 0))
    return pa.table(columns)


def _is_struct_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) and pa.types.is_struct(kind.value_type))


def _write_table(table: pa.Table, path: Path, kind: TableFormat) -> None:
    if kind == "parquet":
        pq.write_table(table, path)
        return
    import pandas as pd  # noqa: PLC0415

    # pandas' Arrow types support empty cells beside integers and nested values.
    frame = table.to_pandas(types_mapper=pd.ArrowDtype)
    ends = "\n"
    for field in table.schema:
        if pa.types.is_list(field.type):
            frame[field.name] = [_to_json(v) for v in table[field.name].to_pylist()]
        elif pa.types.is_binary(field.type):
            frame[field.name] = [_to_base64(v) for v in table[field.name].to_pylist()]
        elif pa.types.is_string(field.type):
            shown = pc.replace_substring_regex(table[field.name], _FORMULA_START, r"'\1")
            frame[field.name] = shown.to_pandas(types_mapper=pd.ArrowDtype)
            if pc.any(pc.match_substring(shown, "\r")).as_py():
                ends = "\r\n"  # only then does csv quote a cell with \r, which also ends a line
    frame.to_csv(path, index=False, lineterminator=ends)


def _to_json(value: list[Any] | None) -> str | None:
    return None if value is None else json.dumps(value, default=_to_base64)


def _to_base64(value: bytes | None) -> str | None:
    return None if value is None else base64.b64encode(value).decode()
