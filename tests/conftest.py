"""Fixtures and settings of all tests."""

import gc
import multiprocessing.util
import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

import dmrl.learn  # noqa: F401  # before any test imports torch, which reads its settings once
from dmrl.rendering import blender_environment

REPOSITORY = Path(__file__).parents[1]

# Imported modules are never freed. Without this, garbage collection scans them again and again.
gc.disable()


def pytest_collection_finish() -> None:
    """Exclude the imported modules from garbage collection, and switch it on for the tests."""
    gc.freeze()
    gc.enable()


# A command that runs in this process removes its own temporary folder at the end. The folder of
# multiprocessing is removed later and must therefore lie elsewhere.
multiprocessing.util.get_temp_dir()

# A shell makes its background jobs, and the processes that they start, ignore SIGINT. Some tests
# send SIGINT to such processes.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No deadline: an example may take long on a busy machine. pytest-timeout ends a test that hangs.
# A few fixed examples keep the tests fast, and every machine sees the same failures.
settings.register_profile("dmrl", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("dmrl")


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of real data: the published set, weights, frames and logs; or skip."""
    folder = Path(os.environ.get("DMRL_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no real data; set DMRL_DATA to the folder that holds it")
    return folder


@pytest.fixture(scope="session")
def blender() -> Path:
    """Return the Python of Blender's environment, or skip where it is not set up."""
    python = blender_environment.find_python()
    if python is None:
        pytest.skip("Blender is not set up; run: dmrl render --setup")
    return python


@pytest.fixture
def empty_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make figures write empty files, because drawing them takes long."""
    style = pytest.importorskip("dmrl.plots.style")

    def savefig(_: object, path: Path, **__: object) -> None:
        path.write_bytes(b"")

    monkeypatch.setattr(style.Figure, "savefig", savefig)
