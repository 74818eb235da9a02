"""Blender's own Python environment: found, or made on first use.

bpy needs Python 3.11 and NumPy 1, which dmrl cannot live with; so it has a virtual
environment of its own below the user's cache folder.
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
WAY_OUT = "Install Python 3.11 (such as: apt-get install python3.11-venv) or uv (pip install uv)"
LIBRARIES = "libgl1 libsm6 libxfixes3 libxi6 libxkbcommon0 libxxf86vm1"


def folder() -> Path:
    """Where the environment is, or will be."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "dmrl" / f"blender-{BLENDER}"


def python() -> Path | None:
    """Python of the environment; None where it has not been made."""
    found = folder() / "bin" / "python"
    return found if found.exists() else None


def ensure(say: Callable[[str], None]) -> Path:
    """Python of the environment, made now if it is not there.

    Parameters
    ----------
    say
        Takes lines of news.

    Raises
    ------
    BlenderError
        If there is neither Python 3.11 nor uv, or the packages cannot be had.
    """
    there = python()
    if there is not None:
        return there
    target = folder()
    say(f"Setting up Blender {BLENDER} in {target}: 350 MB to fetch, 1 GB on disk, once")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.partial-{os.getpid()}")
    try:
        _make(partial)
        _try(partial / "bin" / "python")
        # A virtual environment finds itself by where its Python lies: it may be moved whole.
        partial.rename(target)
    except OSError as e:
        if python() is None:  # another process may have been faster
            raise BlenderError(f"cannot set up {target}: {e}. Free its place, try again") from e
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    say("Blender is set up")
    return target / "bin" / "python"


def _make(target: Path) -> None:
    uv, base = shutil.which("uv"), _python_311()
    python = target / "bin" / "python"
    if base is not None:
        _run([base, "-m", "venv", str(target)], "make a virtual environment", WAY_OUT)
        install = [str(python), "-m", "pip", "install", "--disable-pip-version-check", "-q"]
    elif uv is not None:
        _run([uv, "venv", "-q", "--python", PYTHON, str(target)], "get Python 3.11", WAY_OUT)
        install = [uv, "pip", "install", "-q", "--python", str(python)]
    else:
        raise BlenderError(f"Blender needs Python {PYTHON}, and there is none, nor uv. {WAY_OUT}")
    hint = "Check the connection, then: dmrl render --setup"
    _run([*install, *REQUIREMENTS], "fetch Blender (bpy)", hint)


def _python_311() -> str | None:
    """A Python 3.11 that runs; one may be named and not run, as pyenv's are."""
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


def _run(command: list[str], what: str, hint: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        why = next((line for line in reversed(lines) if "error" in line.lower()), "")
        raise BlenderError(f"cannot {what}: {why or f'exit {done.returncode}'}. {hint}")


def _try(python: Path) -> None:
    """Import bpy once, because a missing system library shows only then."""
    hint = f"If a library is missing, install (Debian's names): {LIBRARIES}"
    _run([str(python), "-c", "import bpy"], "start Blender", hint)
