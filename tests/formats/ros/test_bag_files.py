"""Files of a rosbag2 folder that rosbags ignores: SQLite's log, and files not in the metadata."""

import shutil
import sqlite3
from pathlib import Path

import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.formats.ros.bag import load_content
from dmrl.terminal.left_out import count_left_out

from . import ros_writer as ros
from .ros_writer import Sent, make_times

pytestmark = pytest.mark.heavy


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Return a bag of three odometry messages."""
    sent = [Sent("/cf1/odom", t, ros.make_odometry(t)) for t in make_times(3)]
    return ros.write_bag(tmp_path / "bag", sent, "sqlite3")


def test_messages_in_the_log_of_sqlite_are_not_lost(bag: Path) -> None:
    path = bag / "bag.db3"
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode=WAL")
    writer.execute("INSERT INTO messages SELECT NULL, topic_id, timestamp + 1, data FROM messages")
    writer.commit()
    # The copy has the state after a crash, because the database is still open.
    copy = shutil.copytree(bag, bag.with_name("copy"))
    writer.close()
    with pytest.raises(SourceError, match=r"bag\.db3-wal has messages that are not yet in bag\.db"):
        load_content(copy, Options())
    with sqlite3.connect(copy / "bag.db3") as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    database.close()
    heights = [s for s in load_content(copy, Options()).samples if s.topic == "/cf1/height"]
    assert len(heights) == 6


def test_a_folder_without_metadata_names_the_way_out(bag: Path) -> None:
    (bag / "metadata.yaml").unlink()
    assert find_format(bag, None).name == "rosbag2"
    with pytest.raises(SourceError, match=r"ros2 bag reindex .*, or pass one of its files"):
        load_content(bag, Options())


def test_a_file_that_the_metadata_does_not_name_is_counted(bag: Path) -> None:
    shutil.copy(bag / "bag.db3", bag / "bag_1.db3")
    with count_left_out() as left:
        load_content(bag, Options())
    assert left.counts == {"files that metadata.yaml does not name": 1}
