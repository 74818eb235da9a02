"""Reads of one open file, each from its own position."""

from pathlib import Path

import pytest

from dmrl.storage.shared_file import open_raw, share_file


def test_readers_of_one_file_have_their_own_positions(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(range(100)))
    with share_file(path), share_file(path):
        path.unlink()  # the name is opened no more
        one, other = open_raw(path), open_raw(path)
        assert one.read(3) == bytes([0, 1, 2])
        assert other.seek(-2, 2) == 98
        assert (one.seek(1, 1), one.tell(), one.read(1)) == (4, 4, bytes([4]))
        assert other.read() == bytes([98, 99])
    assert one.read(1) == bytes([5])  # outlives the block
    one.close()
    other.close()
    with pytest.raises(FileNotFoundError):
        open_raw(path)


def test_a_file_that_is_not_there_is_left_to_its_readers(tmp_path: Path) -> None:
    with share_file(tmp_path / "none"), pytest.raises(FileNotFoundError):
        open_raw(tmp_path / "none")
