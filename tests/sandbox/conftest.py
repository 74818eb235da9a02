"""Fixtures: a watched folder, and every kind of untrusted input."""

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl import boundary
from dmrl.cli import app
from dmrl.images.codec import encode_png

from ..deploy.networks import random_network
from .box import (
    COLUMNS,
    CONTROLS,
    EACH,
    HOSTILE_TEXT,
    ROBOTS,
    Box,
    write_hostile_recording,
    write_quantized_model,
)


@pytest.fixture
def box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Box:
    """Make the folders of a test: a working folder, inputs, OUT, and a victim beside them."""
    root = tmp_path.resolve()
    for name in ("cwd", "in", "out", "temp", "victim"):
        (root / name).mkdir()
    (root / "victim" / "keep").write_text("precious")
    monkeypatch.chdir(root / "cwd")
    monkeypatch.setattr(tempfile, "tempdir", str(root / "temp"))
    for name in ("TMPDIR", "HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(root / "temp"))
    monkeypatch.delenv("DMRL_DEBUG", raising=False)
    return Box(root)


@pytest.fixture(scope="module", params=[ROBOTS, CONTROLS], ids=["names", "controls"])
def inputs(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with every kind of untrusted input, and a dataset made of them."""
    root = tmp_path_factory.mktemp("hostile")
    bad = write_hostile_recording(root / "bad.mcap", robots=request.param)
    write_hostile_recording(root / "other.mcap", {"x": "[[0, 1]]"}, request.param)
    (root / "each.toml").write_text(EACH)
    (root / "columns.toml").write_text(COLUMNS)
    for name in ("logs", "pictures", "folder"):
        (root / name).mkdir()
    shutil.copy(bad, root / "folder" / "x\x1b[2J.mcap")
    for robot in ("..cf1", "$(touch victim)", "a\nb", "\x1b[2J", "<img src=x>"):
        log = "time_s,range_../../victim/keep_m\n0,1\n1,2\n"
        (root / "logs" / f"{robot}.csv").write_text(log)
        picture = encode_png(np.zeros((48, 64, 3), np.uint8))
        (root / "pictures" / f"{robot}.png").write_bytes(picture)
    layers = tuple(
        replace(layer, name=f"{HOSTILE_TEXT}{k}")
        for k, layer in enumerate(random_network(0).layers)
    )
    named = replace(random_network(0), name=HOSTILE_TEXT, architecture=HOSTILE_TEXT, layers=layers)
    write_quantized_model(root / "model", named)
    source = bad if request.param is ROBOTS else write_hostile_recording(root / "named.mcap")
    made = ["dataset", str(source), str(root / "cards"), "--split", "recordings"]
    assert boundary.run_to_status(lambda: app(made)) == 0
    return root
