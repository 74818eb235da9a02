"""Each command has its own temporary folder, which is removed even after kill -9."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dmrl.guards.temporary_folder import PREFIX

MAKE_FILES = """
import os, sys, tempfile, time
from pathlib import Path
from dmrl.guards.temporary_folder import use_own_temporary_folder
use_own_temporary_folder()
tempfile.mkdtemp(prefix="torchinductor_")
os.system("mktemp -d -t blender_XXXXXX > /dev/null")
"""
MAKE_FILES_AND_DIE = MAKE_FILES + "os.kill(os.getpid(), 9)"
MAKE_FILES_AND_WAIT = MAKE_FILES + "print(os.environ['TMPDIR'], flush=True); input()"


def run(code: str, system: Path) -> int:
    """Return the exit status of a Python program with a temporary folder."""
    environment = os.environ | {"TMPDIR": str(system)}
    environment.pop("DMRL_SYSTEM_TMPDIR", None)
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=False)
    return done.returncode


def test_temporary_files_are_removed_when_the_command_ends(tmp_path: Path) -> None:
    assert run(MAKE_FILES, tmp_path) == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.heavy
def test_temporary_folder_of_a_killed_command_is_removed_at_next_start(tmp_path: Path) -> None:
    assert run(MAKE_FILES_AND_DIE, tmp_path) == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert len(list(left.iterdir())) == 2
    command = "import sys; sys.argv = ['dmrl', '--version']; from dmrl.cli import main; main()"
    assert run(command, tmp_path) == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.heavy
def test_temporary_folder_of_a_running_command_is_kept(tmp_path: Path) -> None:
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", MAKE_FILES_AND_WAIT],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout and other.stdin
        folder = Path(other.stdout.readline().strip())
        assert run(MAKE_FILES, tmp_path) == 0
        assert list(tmp_path.iterdir()) == [folder] and len(list(folder.iterdir())) == 2
        other.stdin.write("\n")
    assert other.returncode == 0 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", ["link", "file", "open to others"])
def test_foreign_files_in_the_temporary_folder_are_kept(what: str, tmp_path: Path) -> None:
    system, victim = tmp_path / "system", tmp_path / "victim"
    system.mkdir()
    victim.mkdir()
    (victim / "data").write_text("kept")
    place = system / f"{PREFIX}abc"
    if what == "link":
        place.symlink_to(victim)
    elif what == "file":
        place.write_text("kept")
    else:
        place.mkdir(mode=0o777)
        place.chmod(0o777)
    assert run(MAKE_FILES, system) == 0
    assert list(system.iterdir()) == [place] and (victim / "data").read_text() == "kept"


def test_unwritable_temporary_folder_leaves_tempdir_unchanged(tmp_path: Path) -> None:
    code = MAKE_FILES.split("tempfile.mkdtemp")[0].replace(
        "\nuse_own", "\ntempfile.tempdir = '/nowhere'\nuse_own"
    )
    check = "assert (tempfile.tempdir, os.environ['TMPDIR']) == ('/nowhere', sys.argv[-1])"
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    words = [sys.executable, "-c", code + check, str(tmp_path)]
    subprocess.run(words, env=environment, check=True)
