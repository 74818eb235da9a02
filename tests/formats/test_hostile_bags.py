"""Hostile ROS bags: decompression bombs, endless SQL views, and definitions with code."""

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
"""ROS 1 checksum of the message definition ``int32 a``."""


def read_all(path: Path) -> None:
    """Read every sample of a bag."""
    for _ in load_content(path, Options()).samples:
        pass


def pack_record(header: dict[str, bytes], data: bytes = b"") -> bytes:
    """Return a record of a ROS 1 bag."""
    fields = b"".join(
        struct.pack("<I", len(key) + 1 + len(value)) + f"{key}=".encode() + value
        for key, value in header.items()
    )
    return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data


def pack_numbers(*values: int) -> bytes:
    """Return little-endian unsigned numbers of 32 bits."""
    return struct.pack(f"<{len(values)}I", *values)


def write_ros1_bag(path: Path, chunk: bytes, size: int, kind: str, compression: str) -> Path:
    """Write a ROS 1 bag of one chunk, which claims ``size`` bytes, and one connection."""
    said = {"topic": b"/cf1/odom", "type": kind.encode(), "md5sum": MD5.encode()}
    fields = {**said, "message_definition": b"int32 a\n"}
    about = pack_record(fields)[4:-4]
    connection = pack_record({"op": b"\x07", "conn": pack_numbers(0), "topic": b"/cf1/odom"}, about)
    body = pack_record(
        {"op": b"\x05", "compression": compression.encode(), "size": pack_numbers(size)}, chunk
    ) + pack_record(
        {"op": b"\x04", "ver": pack_numbers(1), "conn": pack_numbers(0), "count": pack_numbers(1)},
        pack_numbers(0, 0, 0),
    )
    start = 13 + 4096

    def pack_head(index: int, fill: int) -> bytes:
        places = {"op": b"\x03", "index_pos": struct.pack("<Q", index)}
        return pack_record(
            {**places, "conn_count": pack_numbers(1), "chunk_count": pack_numbers(1)}, b" " * fill
        )

    filled = pack_head(start + len(body), 4096 - len(pack_head(0, 0)))
    place = {"op": b"\x06", "ver": pack_numbers(1), "chunk_pos": struct.pack("<Q", start)}
    times = {
        "start_time": pack_numbers(0, 0),
        "end_time": pack_numbers(1, 0),
        "count": pack_numbers(1),
    }
    path.write_bytes(
        b"#ROSBAG V2.0\n"
        + filled
        + body
        + connection
        + pack_record(place | times, pack_numbers(0, 1))
    )
    return path


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lower the memory limit, because a bomb beyond the true limit takes seconds."""
    monkeypatch.setattr(limits, "MEMORY_BYTES", 64 << 20)


@pytest.mark.usefixtures("small_limit")
@pytest.mark.heavy
def test_a_chunk_of_ros_1_that_unpacks_to_much_is_refused(tmp_path: Path) -> None:
    zeros = bz2.compress(bytes(1 << 20)) * 200  # bz2 decompresses concatenated streams
    path = write_ros1_bag(tmp_path / "a.bag", zeros, 200 << 20, "nav_msgs/Odometry", "bz2")
    assert path.stat().st_size < 100_000
    with pytest.raises(SourceError, match="decompresses to much more than its size explains"):
        read_all(path)


@pytest.mark.usefixtures("small_limit")
def test_a_compressed_file_of_a_bag_does_not_fill_the_disk(tmp_path: Path) -> None:
    frame = zstandard.compress(bytes(1 << 24))
    (tmp_path / "a.db3.zstd").write_bytes(frame * 10)
    (tmp_path / "metadata.yaml").write_text(FOLDER)
    with pytest.raises(SourceError, match="decompresses to much more than its size explains"):
        read_all(tmp_path)


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
        read_all(path)


@pytest.mark.parametrize(
    "kind",
    [
        'a/msg/b:\n pass\nopen("{}", "w")\nclass x',
        'nav_msgs/Odometry\n"""\nopen("{}", "w")\n"""',
        "a/b'): open(\"{}\", 'w'), ('",
    ],
)
def test_the_name_of_a_type_is_not_run(tmp_path: Path, kind: str) -> None:
    """rosbags generates Python code from definitions, so the names in them must be checked."""
    mark = tmp_path / "run"
    path = write_ros1_bag(tmp_path / "a.bag", bytes(8), 8, kind.format(mark), "none")
    with pytest.raises(SourceError):
        read_all(path)
    assert not mark.exists()


@pytest.mark.parametrize("begin", [b"", b"#ROSBAG V2.0", b"#ROSBAG V1.2\n"])
def test_endless_first_line_is_not_read(tmp_path: Path, begin: bytes) -> None:
    """rosbags reads the first line of a ROS 1 bag, which may be a gigabyte without a newline."""
    path = tmp_path / "a.bag"
    path.write_bytes(begin)
    os.truncate(path, 1 << 30)
    with pytest.raises(SourceError, match="does not begin as"):
        read_all(path)
