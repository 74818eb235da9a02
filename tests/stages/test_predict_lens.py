"""Depths of a network are valid for the focal lengths of its training only."""

import json
from pathlib import Path

import pytest

from dmrl.deploy.detector import read_focal_lengths
from dmrl.errors import ModelError
from dmrl.learn.inference.loaded_model import Model, load_model, save_model
from dmrl.learn.networks.architectures import build_network
from dmrl.messages import message_class
from dmrl.prediction import warn_about_lens
from dmrl.recording import Provenance, RecordingWriter


def write_calibration(path: Path, focal_px: float) -> Path:
    """Write a recording of one calibration with this focal length, pixels."""
    k = [focal_px, 0.0, 160.0, 0.0, focal_px, 112.0, 0.0, 0.0, 1.0]
    calibration = message_class("CameraCalibration")(width=320, height=224, K=k)
    with RecordingWriter(path, Provenance("test")) as out:
        out.write(0, "/cf1/camera/calibration", calibration)
    return path


@pytest.mark.parametrize(("focal_px", "line"), [(184.0, ""), (122.0, ""), (368.0, "0.50 times")])
def test_another_focal_length_than_the_models_gets_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], focal_px: float, line: str
) -> None:
    warn_about_lens(Path("dmrl-nano"), write_calibration(tmp_path / "a.mcap", focal_px))
    told = capsys.readouterr().err
    assert line in told and bool(told) == bool(line)


def test_focal_lengths_are_part_of_a_model(tmp_path: Path) -> None:
    network = build_network("dmrl-nano", seed=1).eval()
    save_model(Model(network, "dmrl-nano", focal_px=[230.0]), tmp_path)
    assert load_model(tmp_path).focal_px == read_focal_lengths(tmp_path) == [230.0]


@pytest.mark.parametrize("value", [184, ["x"], [None], [0.0], [float("nan")]])
def test_damaged_focal_lengths_are_one_error(tmp_path: Path, value: object) -> None:
    (tmp_path / "model.json").write_text(json.dumps({"focal_px": value}))
    with pytest.raises(ModelError, match="is damaged"):
        read_focal_lengths(tmp_path)
