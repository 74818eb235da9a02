"""The set-up of Blender's environment, and its failures."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dmrl.errors import BlenderError
from dmrl.rendering import blender_environment


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the cache, where the environment is made, in a temporary folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_missing_python_311_and_uv_error_names_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.setattr(blender_environment, "_find_python_311", lambda: None)
    with pytest.raises(BlenderError, match=r"needs Python 3.11.*nor uv.*pip install uv"):
        blender_environment.ensure_environment(lambda _: None)
    assert list((tmp_path / "dmrl").iterdir()) == []


def test_failed_download_is_reported_and_leaves_no_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        code = 1 if "install" in command else 0
        return subprocess.CompletedProcess(command, code, "True\n", "ERROR: No route to host\n")

    monkeypatch.setattr(subprocess, "run", fail)
    with pytest.raises(BlenderError, match=r"No route to host. Check the connection"):
        blender_environment.ensure_environment(lambda _: None)
    assert list((tmp_path / "dmrl").iterdir()) == []


def test_an_existing_environment_is_used(tmp_path: Path) -> None:
    python = blender_environment.environment_folder() / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    assert blender_environment.find_python() == python
    assert blender_environment.ensure_environment(lambda _: pytest.fail("a message")) == python
