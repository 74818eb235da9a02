"""Blender's own Python environment, found or created on first use.

bpy needs Python 3.11 and NumPy 1, which dmrl does not support. It therefore has a separate
virtual environment below the user's cache folder.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from dmrl.errors import BlenderError

BLENDER = "4.5"
PYTHON = "3.11"
REQUIREMENTS = ("bpy>=4.5.4,<4.6", "numpy>=1.26,<2")
INSTALL_HINT = (
    "Install Python 3.11 (such as: apt-get install python3.11-venv) or uv (pip install uv)"
)
SYSTEM_LIBRARIES = "libgl1 libsm6 libxfixes3 libxi6 libxkbcommon0 libxxf86vm1"


def environment_folder() -> Path:
    """Return the folder of the environment, whether it exists or not."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "dmrl" / f"blender-{BLENDER}"


def find_python() -> Path | None:
    """Return the Python of the environment, or None if it was not created yet."""
    found = environment_folder() / "bin" / "python"
    return found if found.exists() else None


def ensure_environment(report: Callable[[str], None]) -> Path:
    """Return the Python of the environment, creating it first if necessary.

    Parameters
    ----------
    report
        Receives progress messages, one line each.

    Raises
    ------
    BlenderError
        If neither Python 3.11 nor uv is installed, or the packages cannot be installed.
    """
    there = find_python()
    if there is not None:
        return there
    target = environment_folder()
    report(f"Setting up Blender {BLENDER} in {target}: 350 MB to fetch, 1 GB on disk, once")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.partial-{os.getpid()}")
    try:
        _create_environment(partial)
        _check_import(partial / "bin" / "python")
        # A virtual environment locates itself from its Python's path, so it can be moved whole.
        partial.rename(target)
    except OSError as e:
        if find_python() is None:  # another process may have been faster
            raise BlenderError(f"cannot set up {target}: {e}. Remove it and try again") from e
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    report("Blender is set up")
    return target / "bin" / "python"


def _create_environment(target: Path) -> None:
    uv, base = shutil.which("uv"), _find_python_311()
    python = target / "bin" / "python"
    if base is not None:
        _run_command([base, "-m", "venv", str(target)], "make a virtual environment", INSTALL_HINT)
        install = [str(python), "-m", "pip", "install", "--disable-pip-version-check", "-q"]
    elif uv is not None:
        _run_command(
            [uv, "venv", "-q", "--python", PYTHON, str(target)], "get Python 3.11", INSTALL_HINT
        )
        install = [uv, "pip", "install", "-q", "--python", str(python)]
    else:
        raise BlenderError(
            f"Blender needs Python {PYTHON}; neither it nor uv was found. {INSTALL_HINT}"
        )
    hint = "Check the connection, then: dmrl render --setup"
    _run_command([*install, *REQUIREMENTS], "fetch Blender (bpy)", hint)


def _find_python_311() -> str | None:
    """Return a Python 3.11 that runs, or None: a shim on PATH, such as pyenv's, may fail."""
    own = sys.executable if sys.version_info[:2] == (3, 11) else None
    for name in (shutil.which(f"python{PYTHON}"), own):
        if name is None:
            continue
        asked = subprocess.run(
            [name, "-c", "import sys; print(sys.version_info[:2] == (3, 11))"],
            capture_output=True,
            text=True,
            check=False,
        )
        if asked.stdout.strip() == "True":
            return name
    return None


def _run_command(command: list[str], action: str, hint: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        why = next((line for line in reversed(lines) if "error" in line.lower()), "")
        raise BlenderError(f"cannot {action}: {why or f'exit {done.returncode}'}. {hint}")


def _check_import(python: Path) -> None:
    """Import bpy once: a missing system library is only detected by an import."""
    hint = f"If a library is missing, install (Debian's names): {SYSTEM_LIBRARIES}"
    _run_command([str(python), "-c", "import bpy"], "start Blender", hint)
