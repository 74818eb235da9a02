"""Training on unlabelled flights: the consistency loss lowers the error in their rooms."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl import recipe as recipes
from dmrl.errors import MissingTopic
from dmrl.learn.training.config import TrainConfig
from dmrl.recording import read
from dmrl.stages import convert, dataset, fly, predict, sketch, train
from dmrl.stages.fly import Flags, Settings

PLACES = 641, 642, 643, 644


def fly_in_place(out: Path, place: int, seed: int, **flags: float) -> Path:
    """Fly in a room; the seed sets the path."""
    wanted = Flags(seed=seed, place=place, eye="ideal", camera_renderer="sketch", **flags)
    fly.run(out, recipes.load("fly_follow", "fly", Settings, wanted))
    return out


def make_dataset(folder: Path, images: int) -> Path:
    """Make a dataset of sketched images of other rooms."""
    sketch.run(folder / "pictures", sketch.Settings(images=images, empty_share=0.4, seed=5))
    convert.run(folder / "pictures", folder / "pictures.mcap", convert.Settings())
    dataset.run([folder / "pictures.mcap"], folder / "set", dataset.Settings(split="none"))
    return folder / "set"


def measure_depth_error(model: Path, flight: Path, out: Path) -> float:
    """Return the mean absolute depth error of the leaders that are detected, metres."""
    predict.run(model, flight, out, predict.Settings())
    errors = []
    for label, found in zip(read(out, "/cf1/labels"), read(out, "/cf1/detections"), strict=True):
        for peer in label.message.peers:
            best = found.message.detections[0]
            if np.hypot(best.u_px - peer.u_px, best.v_px - peer.v_px) <= 16:
                errors.append(abs(best.depth_m - peer.depth_m))
    assert len(errors) > 150
    return float(np.mean(errors))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_flight_without_labels_lowers_the_depth_error_in_its_place(tmp_path: Path) -> None:
    flown = [fly_in_place(tmp_path / f"{place}.mcap", place, 1) for place in PLACES]
    judged = fly_in_place(tmp_path / "judged.mcap", PLACES[1], 11)
    data = make_dataset(tmp_path, 300)
    settings = replace(
        recipes.load("own_camera", "train", TrainConfig),
        epochs=8,
        epoch_images=160,
        warmup_epochs=1,
        plain_epochs=3,
        frozen_norm_epochs=3,
        learning_rate=5e-4,
    )
    errors = []
    for name, flights in (("without", []), ("with", flown)):
        init = Path("dmrl-nano")
        train.run(data, tmp_path / name, settings, init=init, unlabelled=flights)
        errors.append(measure_depth_error(tmp_path / name, judged, tmp_path / f"{name}.mcap"))
    assert errors[1] < 0.95 * errors[0]


@pytest.mark.heavy
def test_flights_without_labels_are_inputs_and_need_detections(tmp_path: Path) -> None:
    data = make_dataset(tmp_path, 8)
    flight = fly_in_place(tmp_path / "flight.mcap", 1, 1, duration_s=2.0)
    settings = TrainConfig(epochs=1, batch_size=8)
    train.run(data, tmp_path / "model", settings, unlabelled=[flight])
    inputs = read_provenance(tmp_path / "model")
    assert inputs == ["set", "flight.mcap"]
    with pytest.raises(MissingTopic, match="detections"):
        train.run(data, tmp_path / "other", settings, unlabelled=[tmp_path / "pictures.mcap"])
    assert not (tmp_path / "other").exists()


def read_provenance(model: Path) -> list[str]:
    """Return the names of the inputs of a model."""
    made = json.loads((model / "provenance.json").read_text())
    return [one["name"] for one in made["inputs"]]
