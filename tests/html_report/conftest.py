"""Outputs for reports."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dmrl
from dmrl.images.codec import encode_png


def make_figure(value: float | None) -> dict[str, float | None]:
    """Return a figure with a confidence interval of 10 %."""
    low = None if value is None else value * 0.9
    return {"value": value, "low": low, "high": None if value is None else value * 1.1}


def make_evaluation(**changes: Any) -> dict[str, Any]:
    """Return an invented document of `dmrl evaluate`."""
    names = ("median_px", "within_8_px", "within_20_px", "depth_mae_m")
    names += ("precision", "recall", "f1", "ap_16_px")
    band = {name: make_figure(0.5) for name in names}
    bands = [{"from_m": a, "to_m": b, **band} for a, b in ((0.0, 1.0), (1.0, None))]
    curves = {
        "confidence": [0.9, 0.5],
        "precision": [1.0, 0.5],
        "recall": [0.5, 1.0],
        "bin_confidence": [None] * 8 + [0.5, 0.9],
        "bin_right": [None] * 8 + [0.5, 1.0],
        "bin_count": [0] * 8 + [1, 1],
    }
    return {
        "recording": {"name": "found.mcap", "sha256": "0" * 64},
        "against": "truth",
        "split": "test",
        "threshold": 0.3,
        "images": 12,
        "labels": 9,
        "overall": band,
        "bands": bands,
        "curves": curves,
    } | changes


@pytest.fixture(name="evaluation")
def evaluation_fixture() -> Callable[..., dict[str, Any]]:
    """Return a function that returns a document of `dmrl evaluate`."""
    return make_evaluation


@pytest.fixture(scope="session")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a flight and its labelled copy."""
    folder = tmp_path_factory.mktemp("flights")
    flight = dmrl.fly(folder / "flight.mcap", duration_s=20.0, noise="calibrated", seed=1)
    dmrl.label(flight, folder / "labelled.mcap")
    return folder


@pytest.fixture
def outputs(tmp_path: Path, flights: Path) -> Path:
    """Return a folder with flights, an evaluation, a model and images."""
    folder = tmp_path / "out"
    shutil.copytree(flights, folder)
    (folder / "judged").mkdir()
    (folder / "model").mkdir()
    (folder / "judged/evaluation.json").write_text(json.dumps(make_evaluation()))
    picture = encode_png(np.zeros((8, 8, 3), np.uint8))
    (folder / "judged/examples.png").write_bytes(picture)
    (folder / "view.png").write_bytes(picture)
    history = [{"loss": 3.0}, {"loss": 2.0}]
    about = {"architecture": "locanet", "parameters": 24778, "threshold": 0.33}
    about |= {"label_source": "truth", "training": {"images": 480, "history": history}}
    (folder / "model/model.json").write_text(json.dumps(about))
    return folder
