"""Queries of a catalogue: the WHERE clause of DuckDB's SQL.

There is one row per recording, camera and label source. A recording matches if any of its rows
does. A query can read only these columns: no files and no other tables.
"""

import json
import re
from pathlib import Path

import pyarrow as pa

from dmrl.catalogue.table import FILE_NAME, Catalogue, file_stamp, open_catalogue
from dmrl.errors import RecordingError, SettingError, optional_imports, suggest
from dmrl.guards import limits
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.cage import run_caged
from dmrl.guards.safe_names import safe_join

FLAT_QUERY = """
WITH seen AS (SELECT recording, unnest(cameras) AS c FROM held),
counted AS (SELECT recording, unnest(labels) AS l FROM held),
labelled AS (
  SELECT recording, l.camera AS camera, l.source AS source, sum(l.count)::BIGINT AS labels,
    coalesce(sum(l.count) FILTER (l.status = 'OK'), 0)::BIGINT AS ok_labels
  FROM counted GROUP BY ALL
)
SELECT held.* REPLACE (
    [one.topic FOR one IN held.topics] AS topics,
    [one.camera FOR one IN held.cameras] AS cameras,
    coalesce(labelled.labels, 0) AS labels
  ),
  coalesce(seen.c.camera, labelled.camera) AS camera, seen.c.images AS images,
  seen.c.width_px AS width_px, seen.c.height_px AS height_px, seen.c.focal_px AS focal_px,
  labelled.source AS source, coalesce(labelled.ok_labels, 0) AS ok_labels
FROM held LEFT JOIN seen ON seen.recording = held.recording
LEFT JOIN labelled ON labelled.recording = held.recording AND labelled.camera = seen.c.camera
"""
QUERY_KEY = b"query"
"""Key of the query in the metadata of the table that a caged process reads."""
QUOTED_TEXT = re.compile(r"""'(?:[^']|'')*'|"((?:[^"]|"")*)\"""")


def find_rows(catalogue: Catalogue, query: str) -> pa.Table:
    """Return the rows of matching recordings, in the order of their names.

    Parameters
    ----------
    catalogue
        Catalogue of a folder.
    query
        Condition, such as ``camera = 'cf1' and ok_labels > 100``. Text in double quotes that is
        no column name counts as text, so that a shell needs no further quotes.

    Raises
    ------
    SettingError
        If DuckDB rejects the query. Contains DuckDB's message.
    """
    buffer = pa.BufferOutputStream()
    schema = catalogue.table.schema.with_metadata({QUERY_KEY: query.encode()})
    with pa.ipc.new_stream(buffer, schema) as stream:
        stream.write_table(catalogue.table.replace_schema_metadata(schema.metadata))
    chosen = run_caged(
        f"{__name__}:select_names", buffer.getvalue().to_pybytes(), f"the query {query!r}"
    )
    names = set(parse_json(chosen))
    mask = pa.array([name in names for name in catalogue.table["recording"].to_pylist()])
    return catalogue.table.filter(mask.cast(pa.bool_()))


def select_names(request: bytes) -> bytes:
    """Return the names of matching recordings as JSON, from a table with its query as Arrow IPC.

    Raises
    ------
    SettingError
        As `find_rows`.
    """
    with optional_imports("index", "dmrl find"):
        import duckdb  # noqa: PLC0415 - only the caged process needs it

    table = pa.ipc.open_stream(request).read_all()
    query = table.schema.metadata[QUERY_KEY].decode()
    own: dict[str, bool | str] = {
        "enable_external_access": False,
        "autoinstall_known_extensions": False,
        "autoload_known_extensions": False,
        "python_enable_replacements": False,
        # By default it uses most of the memory, then writes to the working directory.
        "memory_limit": f"{limits.MEMORY_BYTES}B",
        "temp_directory": "",
        "lock_configuration": True,
    }
    with duckdb.connect(config=own) as asked:
        flat = asked.from_arrow(table).query("held", FLAT_QUERY)
        try:
            chosen = flat.filter(_convert_quotes(query, flat.columns)).project("recording")
            names = [name for (name,) in chosen.distinct().fetchall()]
        except duckdb.Error as e:
            raise SettingError(_query_error(query, str(e), flat.columns)) from None
    return json.dumps(names).encode()


def find_recordings(folder: Path, query: str) -> list[Path]:
    """Return the matching recordings of a folder, in the order of their names.

    Raises
    ------
    RecordingError
        If the folder has no catalogue, or a recording changed after it was indexed.
    SettingError, MissingExtra
        As `find_rows`.
    """
    found = find_rows(open_catalogue(folder), query)
    rows = zip(found["recording"].to_pylist(), found["stamp"].to_pylist(), strict=True)
    return [_check_unchanged(folder, name, was) for name, was in rows]


def _check_unchanged(folder: Path, name: str, was: str) -> Path:
    path = folder
    for part in name.split("/"):
        path = safe_join(path, part, f"{folder / FILE_NAME}: a recording")
    try:
        same = file_stamp(path) == was
    except OSError:
        same = False
    if not same:
        raise RecordingError(f"{path} has changed since it was indexed. Run: dmrl index {folder}")
    return path


def _convert_quotes(query: str, columns: list[str]) -> str:
    """Convert texts in double quotes to SQL's single quotes."""

    def to_single_quotes(found: re.Match[str]) -> str:
        name = found[1]
        if name is None or name in columns:
            return found[0]
        return "'" + name.replace('""', '"').replace("'", "''") + "'"

    return QUOTED_TEXT.sub(to_single_quotes, query)


def _query_error(query: str, said: str, columns: list[str]) -> str:
    why = said.splitlines()[0].removesuffix("!") if said else "it cannot be answered"
    if unknown := re.search(r'Referenced column "([^"]+)" not found', why):
        why = f"there is no column {unknown[1]}. {suggest(unknown[1], columns, '')}"
    end = " " if why.endswith("?") else ". "
    return f"the query {query!r}: {why.rstrip('. ')}{end}Columns: {', '.join(columns)}"
