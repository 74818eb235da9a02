"""Files that are large, or claim to be, give a one-line error in bounded memory and time.

Each is converted in a process of its own. Its format is given, since it could not be guessed.
"""

import os
import signal
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dmrl.formats.registry import load_builtin_formats

from ..formats.test_fuzz import SOURCES
from .conftest import Count
from .ending import run_to_end
from .workloads import cli

GB = 1 << 30
HANG_S = 1200
"""A conversion that takes longer counts as hanging, even on a busy machine."""
MEMORY_BYTES, CPU_S = 1_000_000_000, 30.0
"""Limits for a small file. A large one may take twice its size more, and 30 s more per GB."""
TEXTS = {
    "csv": ("cf1.csv", b"time_s,x_m,y_m,z_m\n0,1,2,3\n1,1,2,3\n"),
    "cfclient": ("a.csv", b"Timestamp,stateEstimate.x\n0,1\n1,2\n"),
    "locanet": ("posLabel.txt", b"a.png 1 2 3\n"),
}
"""Text formats: the name of a file, and its first lines."""
Make = Callable[[Path], tuple[Path, Path]]


def make_text_source(name: str) -> Make:
    """Return a function that writes a text file of a format; it returns source and file."""

    def make(folder: Path) -> tuple[Path, Path]:
        called, text = TEXTS.get(name, ("a.csv", b"time,a\n1,2\n"))
        (folder / called).write_bytes(text)
        return (folder if name in TEXTS else folder / called), folder / called

    return make


OTHERS = load_builtin_formats().keys() - {name for name, _ in SOURCES.values()}
ALL = {**SOURCES, **{name: (name, make_text_source(name)) for name in sorted(OTHERS)}}


def iter_odd_files(file: Path) -> Iterator[str]:
    """Write a file in several damaged forms; yield the name of each."""
    whole = file.read_bytes()
    for what, data, size in (
        ("garbage", bytes(range(256)) * 12_000, None),
        ("zeros", b"", GB),
        ("sound, then zeros", whole, GB // 8),
        ("a head, then zeros", whole[:64], GB // 8),
        ("a head, then ones", whole[:32] + b"\xff" * 1_000_000, None),
        (
            "counts of 2 to the 31st",
            whole[:40] + struct.pack(">I", 2**31 - 1) * 64 + whole[40:],
            None,
        ),
    ):
        file.write_bytes(data)
        if size is not None:
            os.truncate(file, size)
        yield what


def convert_in_child(source: Path, name: str, out: Path) -> tuple[int, int, float]:
    """Run `dmrl convert` in a child; return its status, peak memory in bytes and CPU time in s."""
    child = os.fork()
    if child == 0:
        try:
            signal.alarm(HANG_S)
            os._exit(run_to_end(lambda: cli("convert", source, out, "--from", name))[0])
        except BaseException:
            os._exit(70)
    _, status, used = os.wait4(child, 0)
    out.unlink(missing_ok=True)
    return os.waitstatus_to_exitcode(status), used.ru_maxrss * 1024, used.ru_utime + used.ru_stime


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("which", ALL)
def test_memory_and_cpu_are_bounded_by_file_size(which: str, tmp_path: Path, count: Count) -> None:
    name, make = ALL[which]
    source, file = make(tmp_path)
    for what in iter_odd_files(file):
        size = file.stat().st_size
        status, took, cpu_s = convert_in_child(source, name, tmp_path / "out.mcap")
        assert status in (0, 1), f"{what}: status {status}"
        assert took < MEMORY_BYTES + 2 * size, f"{what}: {took / 1e6:.0f} MB"
        assert cpu_s < CPU_S * (1 + size / GB), f"{what}: {cpu_s:.0f} s"
        count("foreign files, large or said to be", cases=1, refused=status, right=1 - status)
