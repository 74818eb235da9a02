"""Hostile ROS bags: decompression bombs, endless views, definitions with code."""

import bz2
import os
import sqlite3
import struct
from pathlib import Path

import pytest
import zstandard

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.ros.bag import load_content
from dmrl.guards import limits

TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
    "offered_qos_profiles TEXT); "
    "INSERT INTO topics VALUES(1, '/cf1/odom', 'nav_msgs/msg/Odometry', 'cdr', '');"
)
MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
)
ENDLESS = (
    "WITH RECURSIVE c(id, topic_id, timestamp, data) AS (SELECT 1, 1, 1, x'00' "
    "UNION ALL SELECT id + 1, 1, id, x'00' FROM c) SELECT * FROM c;"
)
FOLDER = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  relative_file_paths: [a.db3.zstd]
  duration: {nanoseconds: 1}
  starting_time: {nanoseconds_since_epoch: 1}
  message_count: 1
  topics_with_message_count:
    - topic_metadata: {name: /cf1/odom, type: nav_msgs/msg/Odometry,
        serialization_format: cdr, offered_qos_profiles: ''}
      message_count: 1
  compression_format: zstd
  compression_mode: FILE
"""
MD5 = "5c9fb1a886e81e3162a5c87bf55c072b"
"""Of ``int32 a``, as ROS 1 sums up a definition."""


def read(path: Path) -> None:
    for _ in load_content(path, Options()).samples:
        pass


def record(header: dict[str, bytes], data: bytes = b"") -> bytes:
    fields = b"".join(
        struct.pack("<I", len(key) + 1 + len(value)) + f"{key}=".encode() + value
        for key, value in header.items()
    )
    return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data


def number(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def ros1_bag(path: Path, chunk: bytes, size: int, kind: str, compression: str) -> Path:
    """A bag of one chunk and one connection."""
    said = {"topic": b"/cf1/odom", "type": kind.encode(), "md5sum": MD5.encode()}
    fields = {**said, "message_definition": b"int32 a\n"}
    about = record(fields)[4:-4]
    connection = record({"op": b"\x07", "conn": number(0), "topic": b"/cf1/odom"}, about)
    body = record(
        {"op": b"\x05", "compression": compression.encode(), "size": number(size)}, chunk
    ) + record(
        {"op": b"\x04", "ver": number(1), "conn": number(0), "count": number(1)}, number(0, 0, 0)
    )
    start = 13 + 4096

    def head(index: int, fill: int) -> bytes:
        places = {"op": b"\x03", "index_pos": struct.pack("<Q", index)}
        return record({**places, "conn_count": number(1), "chunk_count": number(1)}, b" " * fill)

    filled = head(start + len(body), 4096 - len(head(0, 0)))
    place = {"op": b"\x06", "ver": number(1), "chunk_pos": struct.pack("<Q", start)}
    times = {"start_time": number(0, 0), "end_time": number(1, 0), "count": number(1)}
    path.write_bytes(
        b"#ROSBAG V2.0\n" + filled + body + connection + record(place | times, number(0, 1))
    )
    return path


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A smaller bomb is too large already: one of the true size takes seconds."""
    monkeypatch.setattr(limits, "MEMORY_BYTES", 64 << 20)


@pytest.mark.usefixtures("small_limit")
@pytest.mark.heavy
def test_a_chunk_of_ros_1_that_unpacks_to_much_is_refused(tmp_path: Path) -> None:
    zeros = bz2.compress(bytes(1 << 20)) * 200  # bz2 takes one stream after the other
    path = ros1_bag(tmp_path / "a.bag", zeros, 200 << 20, "nav_msgs/Odometry", "bz2")
    assert path.stat().st_size < 100_000
    with pytest.raises(SourceError, match="decompresses to much more than its size explains"):
        read(path)


@pytest.mark.usefixtures("small_limit")
def test_a_compressed_file_of_a_bag_does_not_fill_the_disk(tmp_path: Path) -> None:
    frame = zstandard.compress(bytes(1 << 24))
    (tmp_path / "a.db3.zstd").write_bytes(frame * 10)
    (tmp_path / "metadata.yaml").write_text(FOLDER)
    with pytest.raises(SourceError, match="decompresses to much more than its size explains"):
        read(tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        TOPICS + "CREATE VIEW messages AS " + ENDLESS,
        TOPICS + MESSAGES + "CREATE VIEW schema AS SELECT 4 AS schema_version;",
        TOPICS
        + "CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, "
        + "data BLOB GENERATED ALWAYS AS (zeroblob(1000000000)));",
    ],
)
def test_a_database_that_computes_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as database:
        database.executescript(text)
    with pytest.raises(SourceError, match="has more than tables"):
        read(path)


@pytest.mark.parametrize(
    "kind",
    [
        'a/msg/b:\n pass\nopen("{}", "w")\nclass x',
        'nav_msgs/Odometry\n"""\nopen("{}", "w")\n"""',
        "a/b'): open(\"{}\", 'w'), ('",
    ],
)
def test_the_name_of_a_type_is_not_run(tmp_path: Path, kind: str) -> None:
    """rosbags makes Python of definitions, whose names its grammar must have let through."""
    mark = tmp_path / "run"
    path = ros1_bag(tmp_path / "a.bag", bytes(8), 8, kind.format(mark), "none")
    with pytest.raises(SourceError):
        read(path)
    assert not mark.exists()


@pytest.mark.parametrize("begin", [b"", b"#ROSBAG V2.0", b"#ROSBAG V1.2\n"])
def test_a_line_without_end_is_not_read(tmp_path: Path, begin: bytes) -> None:
    """rosbags reads the first line of a ROS 1 bag, which may be a gigabyte of zeros."""
    path = tmp_path / "a.bag"
    path.write_bytes(begin)
    os.truncate(path, 1 << 30)
    with pytest.raises(SourceError, match="does not begin as"):
        read(path)
