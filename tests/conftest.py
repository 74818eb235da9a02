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

# What is imported stays: Python need not look through all of it for garbage, again and again.
gc.disable()


def pytest_collection_finish() -> None:
    """From the first test on garbage is collected, among what the tests make."""
    gc.freeze()
    gc.enable()


# A command that a test runs in this process has a temporary folder, which is removed before
# multiprocessing removes its own. So that one is not to be in there.
multiprocessing.util.get_temp_dir()

# A shell that starts the tests in the background has them and all they start ignore Ctrl-C, which
# some of them send.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# On a machine that is busy an example may take long; a test that hangs ends by pytest-timeout.
# The same few examples every time: a failure is one that everybody sees, and costs little.
settings.register_profile("dmrl", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("dmrl")


@pytest.fixture(scope="session")
def data() -> Path:
    """Real data: the published set, weights, frames, logs. Skips where they are absent."""
    folder = Path(os.environ.get("DMRL_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no real data; set DMRL_DATA to the folder that holds it")
    return folder


@pytest.fixture(scope="session")
def blender() -> Path:
    """Python of Blender's environment. Skips where it is not set up."""
    python = blender_environment.find_python()
    if python is None:
        pytest.skip("Blender is not set up; run: dmrl render --setup")
    return python


@pytest.fixture
def empty_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made and written where they belong, but without a stroke: that takes long."""
    style = pytest.importorskip("dmrl.plots.style")

    def savefig(_: object, path: Path, **__: object) -> None:
        path.write_bytes(b"")

    monkeypatch.setattr(style.Figure, "savefig", savefig)
