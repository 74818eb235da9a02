"""Messages of ROS bags, through rosbags.

A definition or a message that rosbags cannot read does not affect the others.
"""

import errno
import re
import sqlite3
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from dmrl.errors import DmrlError, SourceError, optional_imports
from dmrl.guards.memory import MemoryLimit, measure_size
from dmrl.terminal.left_out import leave_out

ROS1_MAGIC = b"#ROSBAG V2.0\n"
COMPUTED_TABLE = re.compile(r"\bVIRTUAL\b|\bGENERATED\b|\bAS\s*\(", re.IGNORECASE)
TYPE_NAME = re.compile(r"\w+/msg/\w+")
"""Types that are read. rosbags builds Python code of definitions: their names are checked first."""
METADATA_FILE, STORAGE_FILES = "metadata.yaml", ("*.db3", "*.mcap", "*.db3.zstd", "*.mcap.zstd")
WAL_HEADER_BYTES = 32
"""Size of a log of writes of SQLite that is empty."""
IDL_SEPARATOR = "=" * 80 + "\n"


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One message: topic, type, time at which the bag received it, and the decoded message.

    ``publish_ns`` is its publish time, if that is another.
    """

    topic: str
    kind: str
    bag_ns: int
    decoded: Any
    publish_ns: int | None = None


def list_topics(source: Path) -> list[tuple[str, str, int]]:
    """List topic, type and number of messages of all connections of a bag.

    Raises
    ------
    SourceError
        If the bag cannot be read.
    MissingExtra
        If rosbags is not installed.
    """
    found: Counter[tuple[str, str]] = Counter()
    for connection in _iter_guarded(source, lambda reader: iter(reader.connections)):
        found[connection.topic, connection.msgtype] += connection.msgcount
    return [(topic, kind, count) for (topic, kind), count in found.items()]


def iter_messages(
    source: Path, wanted: Collection[tuple[str, str]], *, ahead: bool = False
) -> Generator[BagMessage]:
    """Yield the messages of some topics and types, in the bag's order; raise as `list_topics`.

    Messages that cannot be decoded are left out, and counted unless ``ahead``: they are read again.
    """

    def messages(reader: Any) -> Iterator[Any]:
        chosen = [c for c in reader.connections if (c.topic, c.msgtype) in wanted]
        definitions = [(c.msgtype, c.msgdef.format.name, c.msgdef.data) for c in chosen]
        decode = build_decoder(definitions, is_ros1=source.suffix == ".bag")
        for connection, bag_ns, data in reader.messages(connections=chosen) if chosen else ():
            decoded = decode(data, connection.msgtype)
            if decoded is None and not ahead:
                reason = f"messages on {connection.topic} that cannot be decoded as"
                leave_out(f"{reason} {connection.msgtype}", source)
            elif decoded is not None:
                yield BagMessage(connection.topic, connection.msgtype, bag_ns, decoded)

    return _iter_guarded(source, messages)


def build_decoder(
    definitions: Collection[tuple[str, str, str]], *, is_ros1: bool
) -> Callable[[bytes, str], Any]:
    """Return a function of data and type that decodes a message; None if that fails.

    Parameters
    ----------
    definitions
        Type, form (MSG or IDL; others: none) and text of each definition.
    is_ros1
        Messages are serialized as by ROS 1, and not in CDR.
    """
    with optional_imports("ros", "messages of ROS"):
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    store = get_typestore(Stores.EMPTY)
    decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    types: dict[str, Any] = {}
    for msgtype, form, text in definitions:
        with suppress(Exception):  # a standard type has a definition of rosbags' own
            types |= _parse_definition(msgtype, form, text)
    if not is_ros1 and not types.keys() >= {msgtype for msgtype, _, _ in definitions}:
        types = get_typestore(Stores.ROS2_HUMBLE).fielddefs | types
    store.register(types)

    def try_to_decode(data: bytes, kind: str) -> Any:
        try:
            return decode(data, kind)
        except MemoryError:
            raise
        except Exception:  # rosbags passes on whatever a wrong message causes
            return None

    return try_to_decode


@lru_cache(maxsize=256)
def _parse_definition(msgtype: str, form: str, text: str) -> dict[str, Any]:
    """Return the types that the definition of a message type contains."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg  # noqa: PLC0415

    if form not in ("MSG", "IDL") or not (text.strip() and TYPE_NAME.fullmatch(msgtype)):
        return {}
    if form == "MSG":
        return dict(get_types_from_msg(text, msgtype))
    if not text.startswith(f"{IDL_SEPARATOR}IDL: "):
        return dict(get_types_from_idl(text))
    found: dict[str, Any] = {}
    for part in text.split(IDL_SEPARATOR)[1:]:
        found |= get_types_from_idl(part.partition("\n")[2])
    return found


def _open_reader(source: Path) -> Any:
    with optional_imports("ros", "a ROS bag"):
        from rosbags import rosbag1, rosbag2  # noqa: PLC0415
    return rosbag1.Reader(source) if source.suffix == ".bag" else rosbag2.Reader(source)


def find_unnamed_files(source: Path) -> list[Path]:
    """Return the files of messages in a bag's folder that its metadata.yaml does not name."""
    text = (source / METADATA_FILE).read_text(errors="replace") if source.is_dir() else ""
    named = {line.strip(" -'\"").rsplit("/", 1)[-1] for line in text.splitlines()}
    held = (path for pattern in STORAGE_FILES for path in source.glob(pattern))
    return sorted(path for path in held if path.name not in named) if named else []


def _check_storage(source: Path) -> None:
    """Raise SourceError unless a bag's SQLite files have tables alone; a view can run any query.

    A ROS 1 bag must begin with its magic: rosbags reads its first line, however long it is. rosbags
    ignores the log of writes that SQLite leaves beside a file when its recording is killed.
    """
    if any(source.glob("*.db3")) and not (source / METADATA_FILE).is_file():
        raise SourceError(
            f"{source} has no {METADATA_FILE}: its recording was killed. Run: ros2 bag reindex "
            f"{source}, or pass one of its files"
        )
    for path in sorted(source.glob("*.db3")) if source.is_dir() else [source]:
        log = path.with_name(f"{path.name}-wal")
        if log.is_file() and log.stat().st_size > WAL_HEADER_BYTES:
            raise SourceError(
                f"{log} has messages that are not yet in {path.name}. Move them there: sqlite3 "
                f"{path} 'PRAGMA wal_checkpoint(TRUNCATE)'"
            )
        with path.open("rb") as stream:
            head = stream.read(16)
        if path.suffix == ".bag" and not head.startswith(ROS1_MAGIC):
            raise SourceError(f"{path} does not begin as a ROS 1 bag 2.0. Pass another file")
        if not head.startswith(b"SQLite format 3"):
            continue
        where = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
        with closing(sqlite3.connect(where, uri=True)) as database:
            for kind, text in database.execute("SELECT type, sql FROM sqlite_master"):
                if kind not in ("table", "index") or COMPUTED_TABLE.search(text or ""):
                    raise SourceError(f"{path} has more than tables. Record the bag again")


def _iter_guarded(source: Path, of: Callable[[Any], Iterator[Any]]) -> Generator[Any]:
    """Yield the items of ``of(reader)``, with any error of rosbags as one line.

    rosbags passes on the errors of sqlite, YAML, struct and its decompressors on damaged bags, so
    all exceptions are caught.
    """
    try:
        bound = MemoryLimit(measure_size(source))
        _check_storage(source)
        reader = _open_reader(source)
        with bound:
            reader.open()
        with closing(reader):
            found = of(reader)
            while True:
                with bound:
                    one = next(found, None)
                if one is None:
                    return
                yield one
    except DmrlError:
        raise
    except Exception as e:
        if isinstance(e, MemoryError) or getattr(e, "errno", None) == errno.EFBIG:
            raise SourceError(
                f"{source} decompresses to much more than its size explains. Record the bag again"
            ) from e
        why = " ".join(str(e).split())[:200] or type(e).__name__
        raise SourceError(f"{source} cannot be read as a ROS bag: {why}. Restore it") from e
