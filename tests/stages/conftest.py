"""A small flight to learn from: bright squares on dark noise, labelled in their middle."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.images import encode_png
from dmrl.learn.model import Model, save_model
from dmrl.learn.network import build
from dmrl.messages import message
from dmrl.recording import SPLIT_METADATA, Provenance, RecordingWriter
from dmrl.topics import attitude, camera_image, labels

STEP_NS = 100_000_000


@pytest.fixture(scope="session")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Thirty images of 64 x 48 px at 10 Hz, twenty for training; attitude in between."""
    path = tmp_path_factory.mktemp("dots") / "dots.mcap"
    rng = np.random.default_rng(0)
    split = {"train": f"[[0, {19 * STEP_NS}]]", "test": f"[[{20 * STEP_NS}, {29 * STEP_NS}]]"}
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.add_metadata(SPLIT_METADATA, split)
        for k in range(30):
            rgb = rng.integers(0, 40, (48, 64, 3), np.uint8)
            row, col = int(rng.integers(1, 5)), int(rng.integers(1, 7))
            rgb[8 * row + 1 : 8 * row + 7, 8 * col + 1 : 8 * col + 7] = 250
            picture = message("CompressedImage")(data=encode_png(rgb), format="png")
            truth = {"peer": "cf2", "u_px": 8 * col + 4, "v_px": 8 * row + 4, "depth_m": 1.2}
            off = {**truth, "v_px": truth["v_px"] + 8, "source": "published"}
            peers = message("PeerLabels")(peers=[{**truth, "source": "truth"}, off])
            sink.write(k * STEP_NS, camera_image("cf1"), picture, publish_ns=k * STEP_NS + 5)
            sink.write(k * STEP_NS, labels("cf1"), peers)
            sink.write(k * STEP_NS + 1, attitude("cf1"), message("Attitude")(roll_rad=k))
    return path


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with an untrained network."""
    folder = tmp_path_factory.mktemp("model")
    save_model(Model(build("locanet", seed=1).eval(), "locanet", threshold=0.4), folder)
    return folder
