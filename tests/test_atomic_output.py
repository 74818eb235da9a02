"""Atomic outputs: complete under their final name, or absent."""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dmrl.atomic_output import (
    as_output_error,
    atomic_file,
    atomic_folder,
    refuse_existing,
    replace_file,
    to_partial_path,
)
from dmrl.errors import OutputError

PATIENCE_S = 120.0
"""Time limit of a process, with a margin for a busy machine."""


def test_a_file_takes_its_name_when_the_block_ends(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    with atomic_file(out) as partial:
        partial.write_text("whole")
        assert partial == tmp_path / "a.mcap.partial"
        assert not out.exists()
    assert out.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [out]


def test_a_failing_block_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), atomic_file(tmp_path / "a") as partial:
        partial.write_text("half")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_folder_takes_its_name_when_the_block_ends(tmp_path: Path) -> None:
    out = tmp_path / "set"
    with atomic_folder(out) as partial:
        (partial / "a").write_text("whole")
        assert not out.exists()
    assert (out / "a").read_text() == "whole"
    assert list(tmp_path.iterdir()) == [out]


def test_a_failing_block_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "set") as partial:
        (partial / "a").write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_work_that_can_be_resumed_is_kept_and_found_again(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt), atomic_folder(out, keep_on_error=True) as partial:
        (partial / "epoch").write_text("3")
        raise KeyboardInterrupt
    assert not out.exists()
    with atomic_folder(out, keep_on_error=True, resume=True) as partial:
        assert (partial / "epoch").read_text() == "3"
    assert (out / "epoch").read_text() == "3"


def test_a_partial_folder_of_a_killed_run_is_cleared(tmp_path: Path) -> None:
    out = tmp_path / "set"
    to_partial_path(out).mkdir()
    (to_partial_path(out) / "stale").write_text("")
    with atomic_folder(out):
        pass
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("kind", ["file", "folder", "dangling link"])
def test_existing_output_is_never_overwritten(tmp_path: Path, kind: str) -> None:
    out = tmp_path / "taken"
    make = {
        "file": lambda: out.write_text("mine"),
        "folder": out.mkdir,
        "dangling link": lambda: out.symlink_to("nowhere"),
    }
    make[kind]()
    for writer in (atomic_file, atomic_folder):
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
def test_refused_writes_give_one_line_errors_with_a_remedy(code: int, words: str) -> None:
    text = str(as_output_error(Path("a.mcap"), OSError(code, os.strerror(code))))
    assert text.startswith(words)
    assert "\n" not in text


@pytest.mark.parametrize("writer", [atomic_file, atomic_folder])
def test_a_full_disk_is_an_output_error_and_leaves_nothing(writer: object, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no space left"), writer(tmp_path / "a"):  # type: ignore[operator]
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


def test_errors_that_are_not_about_the_output_pass_unchanged(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="input"), atomic_file(tmp_path / "a"):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "input")


def test_a_killed_process_leaves_only_the_partial_file(tmp_path: Path) -> None:
    code = (
        "import os, pathlib, signal, sys\n"
        "from dmrl.atomic_output import atomic_file\n"
        "with atomic_file(pathlib.Path(sys.argv[1])) as partial:\n"
        "    partial.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.mcap"], check=False)
    assert done.returncode == -signal.SIGKILL
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.partial"]


WRITER = (
    "import pathlib, sys\n"
    "from dmrl import atomic_output\n"
    "from dmrl.errors import OutputError\n"
    "kind, out, word = sys.argv[1:]\n"
    "try:\n"
    "    with getattr(atomic_output, kind)(pathlib.Path(out)) as partial:\n"
    "        inner = partial / 'a' if kind == 'atomic_folder' else partial\n"
    "        inner.write_text(word)\n"
    "        print('begun', flush=True); sys.stdin.read()\n"
    "        inner.write_text(word * 2)\n"
    "except OutputError as e: sys.exit(str(e))\n"
)


@contextmanager
def _start_writer(kind: str, out: Path, word: str) -> Iterator[subprocess.Popen[str]]:
    """Start another process that writes ``out`` until its standard input is closed."""
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, kind, str(out), word],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


KINDS = pytest.mark.parametrize("kind", ["atomic_file", "atomic_folder"])


@KINDS
@pytest.mark.parametrize("stopped", [False, True])
def test_second_concurrent_writer_gets_one_line_error(
    kind: str, stopped: bool, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with _start_writer(kind, out, "mine") as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "begun\n"
        if stopped:
            first.send_signal(signal.SIGSTOP)
        words = f"out is being written by another dmrl, process {first.pid}"
        for writer in (atomic_file, atomic_folder):
            with pytest.raises(OutputError, match=words), writer(out):
                pytest.fail("the block ran")
        with pytest.raises(OutputError, match=words):
            refuse_existing(out)
        first.send_signal(signal.SIGCONT)
        first.communicate("", timeout=PATIENCE_S)
        assert first.returncode == 0
    inner = out / "a" if kind == "atomic_folder" else out
    assert inner.read_text() == "minemine"
    assert list(tmp_path.iterdir()) == [out]


@KINDS
def test_one_of_many_writers_succeeds_with_complete_output(kind: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-c", WRITER, kind, str(out)]
    words = [str(k) * 4000 for k in range(6)]
    started = [
        subprocess.Popen(
            [*command, word], stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        for word in words
    ]
    output = [process.communicate(timeout=PATIENCE_S)[1] for process in started]
    won = [k for k, process in enumerate(started) if process.returncode == 0]
    assert len(won) == 1
    inner = out / "a" if kind == "atomic_folder" else out
    assert inner.read_text() == words[won[0]] * 2
    assert list(tmp_path.iterdir()) == [out]
    lost = [text for k, text in enumerate(output) if k not in won]
    assert all("is being written by" in text or "exists" in text for text in lost)
    assert all(text.count("\n") == 1 for text in lost)


@KINDS
def test_partial_file_of_a_killed_writer_blocks_no_other(kind: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with _start_writer(kind, out, "half") as first:
        assert first.stdout is not None
        first.stdout.readline()
        first.kill()
        first.wait()
    assert [path.name for path in tmp_path.iterdir()] == ["out.partial"]
    with _start_writer(kind, out, "whole") as second:
        second.communicate("", timeout=PATIENCE_S)
    assert second.returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_hard_linked_partial_file_is_not_truncated(tmp_path: Path) -> None:
    to_partial_path(tmp_path / "a").write_text("whole, killed between its two names")
    (tmp_path / "b").hardlink_to(to_partial_path(tmp_path / "a"))
    with atomic_file(tmp_path / "a") as partial:
        partial.write_text("new")
    assert (tmp_path / "b").read_text().startswith("whole")


@pytest.mark.parametrize("writer", [atomic_file, replace_file])
def test_a_link_in_place_of_the_partial_file_is_not_followed(
    writer: object, tmp_path: Path
) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    to_partial_path(tmp_path / "a").symlink_to(victim)
    with pytest.raises(OutputError, match="symbolic link"), writer(tmp_path / "a"):  # type: ignore[operator]
        pytest.fail("the block ran")
    assert victim.read_text() == "precious"


def test_file_created_meanwhile_is_not_replaced_and_work_is_kept(tmp_path: Path) -> None:
    for writer in (atomic_file, atomic_folder):
        out = tmp_path / writer.__name__
        with pytest.raises(OutputError, match="created by another program"), writer(out) as partial:
            if partial.is_dir():
                out.mkdir()
                (out / "theirs").write_text("")
            else:
                partial.write_text("mine")
                out.write_text("theirs")
        assert partial.exists()
    assert (tmp_path / "atomic_file").read_text() == "theirs"


@pytest.mark.parametrize("writer", [atomic_file, atomic_folder])
def test_a_read_only_disk_is_one_error(
    writer: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: object, *_: object, **__: object) -> int:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    for name in ("open", "mkdir", "unlink"):
        monkeypatch.setattr(os, name, refuse)
    with pytest.raises(OutputError, match="Read-only file system"), writer(tmp_path / "a"):  # type: ignore[operator]
        pytest.fail("the block ran")


def test_output_is_synced_before_it_is_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, seen = tmp_path / "set", []
    monkeypatch.setattr(
        os, "fsync", lambda fd: seen.append((Path(f"/proc/self/fd/{fd}").readlink(), out.exists()))
    )
    with atomic_folder(out) as partial:
        (partial / "inner").mkdir()
        (partial / "inner" / "a").write_text("x")
    names = [(str(name.relative_to(tmp_path)), stood) for name, stood in seen]
    assert names == [
        ("set.partial/inner/a", False),
        ("set.partial/inner", False),
        ("set.partial", False),
        (".", True),
    ]


@pytest.mark.parametrize("writer", [atomic_file, atomic_folder])
def test_a_disk_that_fails_to_sync_leaves_nothing(
    writer: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.fsync
    left: list[int] = []

    def fail(fd: int) -> None:
        if not left.pop():
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        real(fd)

    monkeypatch.setattr(os, "fsync", fail)
    for good in (0, 1):
        left[:] = [0] + [1] * good
        with pytest.raises(OutputError, match="Input/output error"), writer(tmp_path / "a") as p:  # type: ignore[operator]
            (p / "x" if p.is_dir() else p).write_text("x")
        assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_opened_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.open

    def refused(path: Any, flags: int, *rest: Any) -> int:
        if str(path).endswith("set.partial") and (tmp_path / "set.partial").exists():
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return real(path, flags, *rest)

    monkeypatch.setattr(os, "open", refused)
    with pytest.raises(OutputError, match="cannot write"), atomic_folder(tmp_path / "set"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_overlong_name_is_refused_before_any_work(tmp_path: Path) -> None:
    for length in (248, 256, 5000):
        with pytest.raises(OutputError, match="Give one of 247 bytes"):
            refuse_existing(tmp_path / ("a" * length))
    refuse_existing(tmp_path / ("a" * 247))


def test_folder_removed_during_writing_is_reported(tmp_path: Path) -> None:
    gone = pytest.raises(OutputError, match="was removed while it was written")
    with gone, atomic_folder(tmp_path / "set") as partial:
        partial.rmdir()
        (partial / "a").write_text("x")
