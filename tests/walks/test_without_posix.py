"""Commands start and work where modules, functions and signals of POSIX are missing.

This is not Windows: it shows that nothing that only POSIX has is needed. README.md says what was
tried on which system.
"""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.heavy, pytest.mark.timeout(1200)]
HIDE = """
import os, signal, sys
import multiprocessing, subprocess, tempfile  # their own use of POSIX is not in question
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


def dmrl(place: Path, *words: str) -> str:
    line = [sys.executable, "-c", HIDE, *words]
    done = subprocess.run(line, cwd=place, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


def test_the_first_commands_work_without_posix(tmp_path: Path) -> None:
    assert "Usage: dmrl train" in dmrl(tmp_path, "train", "--help")
    dmrl(tmp_path, "sketch", "pictures", "--images", "24")
    dmrl(tmp_path, "convert", "pictures", "pictures.mcap")
    assert "/cf1/labels" in dmrl(tmp_path, "info", "pictures.mcap")
    dmrl(tmp_path, "check", "pictures.mcap")
    dmrl(tmp_path, "dataset", "pictures.mcap", "dataset")
    dmrl(tmp_path, "train", "dataset", "model", "--epochs", "1")
    dmrl(tmp_path, "predict", "model", "pictures.mcap", "seen.mcap")
    dmrl(tmp_path, "export", "dmrl-nano", "network")
    dmrl(tmp_path, "fly", "fly_in_view", "flight.mcap", "--duration-s", "20")
    dmrl(tmp_path, "label", "flight.mcap", "labelled.mcap")
    made = {path.name for path in tmp_path.iterdir()}
    assert {"dataset", "model", "seen.mcap", "network", "labelled.mcap"} <= made
    assert not [name for name in made if name.endswith(".partial")]
