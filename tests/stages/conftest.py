"""A small labelled flight, with models and a dataset, for fast tests of training."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dmrl.datasets import open_dataset
from dmrl.evaluation import quantization_report
from dmrl.images.codec import encode_png
from dmrl.learn.inference.loaded_model import Model, save_model
from dmrl.learn.networks.architectures import build_network, normalize_images
from dmrl.messages import message_class
from dmrl.recording import SPLIT_METADATA, Provenance, RecordingWriter
from dmrl.stages import dataset, fly, quantize
from dmrl.topics import ATTITUDE, CAMERA_IMAGE, LABELS

STEP_NS = 100_000_000


@pytest.fixture(scope="session")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return thirty labelled images of 64 x 48 px at 10 Hz, twenty of them for training.

    A peer is a bright square on dark noise. The attitude of the robot follows each image.
    """
    path = tmp_path_factory.mktemp("dots") / "dots.mcap"
    rng = np.random.default_rng(0)
    split = {"train": f"[[0, {19 * STEP_NS}]]", "test": f"[[{20 * STEP_NS}, {29 * STEP_NS}]]"}
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.add_metadata(SPLIT_METADATA, split)
        for k in range(30):
            rgb = rng.integers(0, 40, (48, 64, 3), np.uint8)
            row, col = int(rng.integers(1, 5)), int(rng.integers(1, 7))
            rgb[8 * row + 1 : 8 * row + 7, 8 * col + 1 : 8 * col + 7] = 250
            picture = message_class("CompressedImage")(data=encode_png(rgb), format="png")
            truth = {"peer": "cf2", "u_px": 8 * col + 4, "v_px": 8 * row + 4, "depth_m": 1.2}
            off = {**truth, "v_px": truth["v_px"] + 8, "source": "published"}
            peers = message_class("PeerLabels")(peers=[{**truth, "source": "truth"}, off])
            sink.write(k * STEP_NS, CAMERA_IMAGE("cf1"), picture, publish_ns=k * STEP_NS + 5)
            sink.write(k * STEP_NS, LABELS("cf1"), peers)
            sink.write(k * STEP_NS + 1, ATTITUDE("cf1"), message_class("Attitude")(roll_rad=k))
    return path


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an untrained network."""
    folder = tmp_path_factory.mktemp("model")
    save_model(Model(build_network("locanet", seed=1).eval(), "locanet", threshold=0.4), folder)
    return folder


@pytest.fixture(scope="session")
def dots_dataset(dots: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the dataset of `dots`."""
    out = tmp_path_factory.mktemp("dots-dataset") / "dots"
    dataset.run([dots], out, dataset.Settings())
    return out


@pytest.fixture(scope="session", params=["locanet", "dmrl-nano"])
def random_model(
    request: pytest.FixtureRequest, dots_dataset: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Return the folder of a network with random weights.

    The batch normalisations have the statistics of the images of `dots`.
    """
    network = build_network(request.param, seed=1).train()
    images = np.concatenate(open_dataset(dots_dataset).split("train").pixels)
    seen = normalize_images(torch.from_numpy(images).permute(0, 3, 1, 2))
    for norm in network.modules():
        if isinstance(norm, torch.nn.BatchNorm2d):
            norm.momentum = 1.0  # keep the statistics of the last batch only
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=torch.manual_seed(2))
        network(seen)
    folder = tmp_path_factory.mktemp("settled") / request.param
    folder.mkdir()
    save_model(Model(network.eval(), request.param, width_px=64, height_px=48), folder)
    return folder


@pytest.fixture(scope="session")
def quantised_model(
    random_model: Path, dots_dataset: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Return the int8 form of `random_model`."""
    out = tmp_path_factory.mktemp("quantised") / random_model.name
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quantization_report, "plots", None)
        quantize.run(random_model, dots_dataset, out, quantize.Settings())
    return out


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight of two robots over 30 s with calibrated sensors; cf1 has a camera."""
    out = tmp_path_factory.mktemp("label") / "flight.mcap"
    settings = fly.Settings(
        2, 30.0, noise="calibrated", seed=1001, camera=True, cameras_max=1, camera_rate_hz=2.0
    )
    fly.run(out, settings)
    return out
