"""Commands work where modules, functions and signals of POSIX are missing.

This does not replace a test on Windows. README.md states what was tried on which system.
"""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.heavy, pytest.mark.timeout(1200)]
HIDE = """
import os, signal, sys
import multiprocessing, subprocess, tempfile  # the standard library may use POSIX
for name in ("fcntl", "resource", "termios", "pwd", "grp"):
    sys.modules[name] = None
for name in ("fork", "killpg", "sched_getaffinity", "sched_setaffinity"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGKILL", "SIGHUP"):
    if hasattr(signal, name):
        delattr(signal, name)
sys.argv = ["dmrl", *sys.argv[1:]]
from dmrl.__main__ import main
main()
"""


def run_dmrl(place: Path, *words: str) -> str:
    """Run a command without POSIX; return its standard output."""
    line = [sys.executable, "-c", HIDE, *words]
    done = subprocess.run(line, cwd=place, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


def test_the_first_commands_work_without_posix(tmp_path: Path) -> None:
    assert "Usage: dmrl train" in run_dmrl(tmp_path, "train", "--help")
    run_dmrl(tmp_path, "sketch", "pictures", "--images", "24")
    run_dmrl(tmp_path, "convert", "pictures", "pictures.mcap")
    assert "/cf1/labels" in run_dmrl(tmp_path, "info", "pictures.mcap")
    run_dmrl(tmp_path, "check", "pictures.mcap")
    run_dmrl(tmp_path, "dataset", "pictures.mcap", "dataset")
    run_dmrl(tmp_path, "train", "dataset", "model", "--epochs", "1")
    run_dmrl(tmp_path, "predict", "model", "pictures.mcap", "seen.mcap")
    run_dmrl(tmp_path, "export", "dmrl-nano", "network")
    run_dmrl(tmp_path, "fly", "fly_in_view", "flight.mcap", "--duration-s", "20")
    run_dmrl(tmp_path, "label", "flight.mcap", "labelled.mcap")
    made = {path.name for path in tmp_path.iterdir()}
    assert {"dataset", "model", "seen.mcap", "network", "labelled.mcap"} <= made
    assert not [name for name in made if name.endswith(".partial")]
