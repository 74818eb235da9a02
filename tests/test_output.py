"""Outputs are whole under their name, or absent."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dmrl.errors import OutputError
from dmrl.output import as_output_error, partial_file, partial_folder, partial_of, refuse_existing


def test_a_file_takes_its_name_when_the_block_ends(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    with partial_file(out) as partial:
        partial.write_text("whole")
        assert partial == tmp_path / "a.mcap.partial"
        assert not out.exists()
    assert out.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [out]


def test_a_failing_block_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), partial_file(tmp_path / "a") as partial:
        partial.write_text("half")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_folder_takes_its_name_when_the_block_ends(tmp_path: Path) -> None:
    out = tmp_path / "set"
    with partial_folder(out) as partial:
        (partial / "a").write_text("whole")
        assert not out.exists()
    assert (out / "a").read_text() == "whole"
    assert list(tmp_path.iterdir()) == [out]


def test_a_failing_block_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), partial_folder(tmp_path / "set") as partial:
        (partial / "a").write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_work_that_can_be_resumed_is_kept_and_found_again(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt), partial_folder(out, keep_on_error=True) as partial:
        (partial / "epoch").write_text("3")
        raise KeyboardInterrupt
    assert not out.exists()
    with partial_folder(out, keep_on_error=True) as partial:
        assert (partial / "epoch").read_text() == "3"
    assert (out / "epoch").read_text() == "3"


def test_a_partial_folder_of_a_killed_run_is_cleared(tmp_path: Path) -> None:
    out = tmp_path / "set"
    partial_of(out).mkdir()
    (partial_of(out) / "stale").write_text("")
    with partial_folder(out):
        pass
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("kind", ["file", "folder", "dangling link"])
def test_what_is_there_is_never_overwritten(tmp_path: Path, kind: str) -> None:
    out = tmp_path / "taken"
    make = {
        "file": lambda: out.write_text("mine"),
        "folder": out.mkdir,
        "dangling link": lambda: out.symlink_to("nowhere"),
    }
    make[kind]()
    for writer in (partial_file, partial_folder):
        with pytest.raises(OutputError, match="never overwritten; remove it"), writer(out):
            pytest.fail("the block ran")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_a_missing_folder_is_named_with_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"no folder .*absent.* Try: mkdir -p .*absent"):
        refuse_existing(tmp_path / "absent" / "a.mcap")


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "no space left for a.mcap. Free some"),
        (errno.EDQUOT, "no space left for a.mcap. Free some"),
        (errno.EACCES, "cannot write a.mcap: Permission denied. Choose another place"),
    ],
)
def test_refused_writes_are_one_line_with_the_way_out(code: int, words: str) -> None:
    text = str(as_output_error(Path("a.mcap"), OSError(code, os.strerror(code))))
    assert text.startswith(words)
    assert "\n" not in text


@pytest.mark.parametrize("writer", [partial_file, partial_folder])
def test_a_full_disk_is_an_output_error_and_leaves_nothing(writer: object, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no space left"), writer(tmp_path / "a"):  # type: ignore[operator]
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


def test_errors_that_are_not_about_the_output_pass_unchanged(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="input"), partial_file(tmp_path / "a"):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "input")


def test_a_killed_process_leaves_only_the_partial_file(tmp_path: Path) -> None:
    code = (
        "import os, pathlib, signal, sys\n"
        "from dmrl.output import partial_file\n"
        "with partial_file(pathlib.Path(sys.argv[1])) as partial:\n"
        "    partial.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.mcap"], check=False)
    assert done.returncode == -signal.SIGKILL
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.partial"]
