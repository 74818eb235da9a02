"""`dmrl likeness` fits the look of rendered images to real ones."""

import errno
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dmrl import recipe as recipes
from dmrl.cli import app
from dmrl.errors import (
    FullDisk,
    OutputError,
    RecipeError,
    RecordingError,
    SettingError,
    SourceError,
)
from dmrl.images.codec import decode, encode_png
from dmrl.render_recording import read_render_settings
from dmrl.rendering import preset_fitting
from dmrl.rendering import settings as looks
from dmrl.rendering.backgrounds.rooms import open_rooms
from dmrl.rendering.camera.image_statistics import FIGURES, ImageStatistics
from dmrl.rendering.preset_fitting import sample_scenes, simulate_images
from dmrl.stages.likeness import Settings, run

from ..faults.inputs import Inputs

SIZE_PX = (128, 96)
STRIPES = np.zeros((64, 64, 3), np.uint8)
STRIPES[:, 16:32] = STRIPES[:, 48:] = 255
CAMERAS = {
    "colour": {"warmth": [2.0, 2.6], "brightness": [0.4, 0.5], "defocus_px": [0.9, 1.1]},
    "grey": {"saturation": [0.0, 0.0], "warmth": [1.0, 1.0], "bayer": False, "image_format": "png"},
}


def write_frames(folder: Path, camera: str) -> Path:
    """Write 32 images of a camera that differs from the preset."""
    folder.mkdir()
    own = {"preset": "himax", "read_noise": [0.006, 0.007], **CAMERAS[camera]}
    settings = recipes.check(camera, looks.filled(own), looks.Settings)
    there = sample_scenes(open_rooms(), settings, SIZE_PX, seed=1234)[:32]
    for k, rgb in enumerate(simulate_images(settings, there, seed=1234)):
        (folder / f"{k:02d}.png").write_bytes(encode_png(rgb))
    return folder


def compute_worst_error(found: ImageStatistics, real: ImageStatistics) -> float:
    """Return the largest error of a figure: relative, or absolute for figures below 0.1."""
    pairs = [(getattr(found, name), getattr(real, name)) for name in FIGURES]
    return max(abs(one - other) / (other if other > 0.1 else 1) for one, other in pairs)


@pytest.mark.heavy
@pytest.mark.parametrize("camera", CAMERAS)
def test_fitted_preset_reproduces_the_figures_of_the_frames(camera: str, tmp_path: Path) -> None:
    result = run(write_frames(tmp_path / "own", camera), tmp_path / "own.toml", Settings())
    assert result.frames == 32
    assert compute_worst_error(result.fitted, result.real) < 0.2
    assert compute_worst_error(result.preset, result.real) > 0.2
    settings = read_render_settings(str(tmp_path / "own.toml"))
    assert settings.bayer == (camera == "colour")
    assert (settings.saturation[1] == 0) == (camera == "grey")
    sheet = decode((tmp_path / "own.png").read_bytes())
    assert sheet.shape[0] > 6 * 144


@pytest.mark.heavy
def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    own = write_frames(tmp_path / "own", "grey")
    for name in ("a", "b"):
        run(own, tmp_path / f"{name}.toml", Settings(frames=4))
    for end in (".toml", ".png"):
        assert (tmp_path / f"a{end}").read_bytes() == (tmp_path / f"b{end}").read_bytes()


@pytest.mark.heavy
def test_likeness_reads_recordings_and_prints_json(
    dots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "dots.toml"
    app(["likeness", str(dots), str(out), "--frames", "5", "--json"], result_action="return_value")
    output = capsys.readouterr()
    assert "5 frames: few" in output.err
    made = json.loads(output.out)
    assert made["frames"] == 5 and set(made["fitted"]) == set(FIGURES)
    assert tomllib.loads(out.read_text())["preset"] == "himax"


def test_frames_that_cannot_be_measured_give_one_line_errors(tmp_path: Path, dots: Path) -> None:
    (tmp_path / "none").mkdir()
    with pytest.raises(SourceError, match="no image"):
        run(tmp_path / "none", tmp_path / "a.toml", Settings())
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for name, width in (("a", 64), ("b", 96)):
        pixels = np.zeros((64, width, 3), np.uint8)
        (mixed / f"{name}.png").write_bytes(encode_png(pixels))
    with pytest.raises(SettingError, match="64x64, 96x64 px"):
        run(mixed, tmp_path / "a.toml", Settings())
    (mixed / "b.png").write_bytes(encode_png(np.zeros((20, 20, 3), np.uint8)))
    (mixed / "a.png").unlink()
    with pytest.raises(SettingError, match="too small"):
        run(mixed, tmp_path / "a.toml", Settings())
    with pytest.raises(RecipeError, match="no preset"):
        run(dots, tmp_path / "a.toml", Settings(preset="mine"))
    with pytest.raises(RecordingError):
        run(tmp_path / "none.mcap", tmp_path / "a.toml", Settings())
    for out in (tmp_path / "a.png", Path()):
        with pytest.raises(SettingError, match=r"OUT\.toml"):
            run(dots, out, Settings())
    (tmp_path / "a.png").write_bytes(b"mine")
    with pytest.raises(OutputError):
        run(dots, tmp_path / "a.toml", Settings())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "mixed", "none"]


def write_images(path: Path, frames: list[NDArray[np.uint8]]) -> Path:
    """Write images to a new folder; return it."""
    path.mkdir()
    for k, rgb in enumerate(frames):
        (path / f"{k}.png").write_bytes(encode_png(rgb))
    return path


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ([np.zeros((64, 64, 3), np.uint8)] * 3, r"plain colour, of brightness 0\.00.*something"),
        ([np.full((64, 64, 3), 255, np.uint8)], r"plain colour, of brightness 1\.00"),
        ([STRIPES, STRIPES * np.uint8([1, 0, 1])], "1 grey frames and 1 with colours"),
        ([np.zeros((1100, 1930, 3), np.uint8)], "1930x1100 px are too large.*1920x1080"),
    ],
)
def test_frames_that_show_no_camera_give_one_line_errors(
    frames: list[NDArray[np.uint8]], said: str, tmp_path: Path
) -> None:
    own = write_images(tmp_path / "own", frames)
    with pytest.raises(SettingError, match=said):
        run(own, tmp_path / "a.toml", Settings())
    assert [path.name for path in tmp_path.iterdir()] == ["own"]


@pytest.mark.heavy
def test_unmeasurable_figures_are_reported_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Black and white stripes have sharp edges, but no grain."""
    for name in ("COARSE", "FINE"):
        monkeypatch.setattr(preset_fitting, name, (1, 2))
    own, out = write_images(tmp_path / "own", [STRIPES]), tmp_path / "a.toml"
    app(["likeness", str(own), str(out)], result_action="return_value")
    output = capsys.readouterr()
    assert "holds 1 frame: few" in output.err and "50% of the pixels" in output.err
    assert "does not show grain, levels of 256, grain, neighbours alike" in output.err
    grain = next(line for line in output.out.splitlines() if "levels of 256" in line)
    assert grain.split()[4] == "-" and grain.split()[-2:] == ["-", "-"]
    assert "noise" not in out.read_text()


@pytest.mark.heavy
def test_preview_left_by_a_killed_run_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture is renamed before the recipe, so that a killed run may leave it alone.

    A picture of another program is never replaced, and an error leaves neither file.
    """
    for name in ("COARSE", "FINE"):
        monkeypatch.setattr(preset_fitting, name, (1, 2))
    dots, out = Inputs(tmp_path).dots, tmp_path / "a.toml"
    run(dots, out, Settings())
    made = {end: (tmp_path / f"a{end}").read_bytes() for end in (".toml", ".png")}
    out.rename(tmp_path / "a.toml.partial")
    run(dots, out, Settings())
    assert {end: (tmp_path / f"a{end}").read_bytes() for end in made} == made
    out.rename(tmp_path / "a.toml.partial")
    (tmp_path / "a.png").write_bytes(b"mine")
    with pytest.raises(OutputError, match=r"a\.png exists"):
        run(dots, out, Settings())
    assert (tmp_path / "a.png").read_bytes() == b"mine" and not out.exists()
    (tmp_path / "a.png").unlink()

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(out))

    # The picture is renamed first, the recipe fails.
    monkeypatch.setattr(
        "dmrl.atomic_output.sync", lambda path: fail() if "toml" in path.name else None
    )
    with pytest.raises(FullDisk):
        run(dots, out, Settings())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dots.mcap"]
