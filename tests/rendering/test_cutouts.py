"""Renders of cut-outs: labels that fit the pixels, and colours that fit the background."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dmrl import topics
from dmrl.errors import DmrlError, RecipeError, SettingError, SourceError
from dmrl.geometry.camera_file import find_camera
from dmrl.images.codec import decode, encode_png
from dmrl.recording import iter_columns, read
from dmrl.render_recording import read_render_settings, render_recording
from dmrl.rendering.cutouts import load_cutout, match_backdrop, open_cutouts

CUTOUTS = Path(__file__).parents[3] / "shared/data/cutouts"
WIDTH_M = 0.2


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Return folders of a cut-out, a dark cross 60 px wide, and of bright grey photos."""
    cutouts, photos = tmp_path / "cutouts", tmp_path / "photos"
    cutouts.mkdir()
    photos.mkdir()
    cross = np.zeros((80, 100, 4), np.uint8)
    cross[35:45, 20:80] = cross[25:55, 45:55] = (30, 20, 60, 255)
    Image.fromarray(cross).save(cutouts / "cross.png")
    for k in range(3):
        (photos / f"{k}.png").write_bytes(encode_png(np.full((240, 330, 3), 190 + 8 * k, np.uint8)))
    return cutouts, photos


def write_recipe(folder: Path, cutouts: Path, photos: Path | None, more: str = "") -> Path:
    """Write a render recipe of cut-outs, with further lines of TOML; return its path."""
    recipe = folder / "recipe.toml"
    behind = "" if photos is None else f'backgrounds = "{photos}"\n'
    text = f'kind = "render"\npreset = "cutouts"\ncutouts = "{cutouts}"\n{behind}'
    recipe.write_text(f"{text}cutout_width_m = {WIDTH_M}\nrobot_tilt_max_deg = 0.0\n{more}")
    return recipe


def read_peers(out: Path) -> list[list[dict[str, float]]]:
    """Return the labels of the peers in each image of a recording."""
    batches = iter_columns(out, topics.LABELS("cf1"), fields=["peers"])
    return [row for batch in batches for row in batch["peers"].to_pylist()]


@pytest.mark.heavy
def test_labels_fit_the_dark_pixels(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    more = "images = 30\ndistorted = false\nempty_share = 0.2\nplace_u = [0.3, 0.7]\n"
    recipe = write_recipe(tmp_path, *folders, more + "place_v = [0.3, 0.7]\n")
    out = tmp_path / "out.mcap"
    done = render_recording(out, read_render_settings(str(recipe)))
    assert done.images == 30
    assert 0 < done.empty_images < 30
    camera = find_camera(Path("aideck"))
    checked = 0
    for sample, peers in zip(read(out, topics.CAMERA_IMAGE("cf1")), read_peers(out), strict=True):
        rgb = decode(sample.message.data, out).astype(float)
        dark = rgb.mean(axis=2) < rgb.mean(axis=2).max() - 60
        for peer in peers:
            left, top, right, bottom = peer["box_px"]
            width_px = camera.fx_px * WIDTH_M / peer["depth_m"]
            if left <= 0 or top <= 0 or right >= 320 or bottom >= 224 or width_px < 20:
                continue
            checked += 1
            assert right - left == pytest.approx(width_px, abs=4)
            assert (left + right) / 2 == pytest.approx(peer["u_px"], abs=2)
            rows, columns = np.nonzero(dark)
            assert columns.min() + 0.5 >= left - 4
            assert np.median(columns) == pytest.approx(peer["u_px"], abs=4)
            assert np.median(rows) == pytest.approx(peer["v_px"], abs=4)
    assert checked >= 5


@pytest.mark.heavy
def test_the_same_seed_gives_the_same_bytes(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    recipe = write_recipe(tmp_path, *folders, "images = 6\n")
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    for out in (first, second):
        render_recording(out, read_render_settings(str(recipe)))
    assert first.read_bytes() == second.read_bytes()


def test_cutout_is_matched_to_colour_light_and_noise() -> None:
    rng = np.random.default_rng(0)
    light = np.concatenate([np.tile([0.5, 0.1, 0.1], (20, 30, 1)), np.ones((20, 30, 1))], axis=2)
    light = light.astype(np.float32)
    grey = np.full((100, 120, 3), 0.15, np.float32)
    found = match_backdrop(light, grey, rng, brightness=True)
    assert np.ptp(found[..., :3], axis=2).max() < 1e-3
    brighter = match_backdrop(light, 4 * grey, rng, brightness=True)
    assert brighter[..., 0].mean() == pytest.approx(4 * found[..., 0].mean(), rel=0.05)
    grainy = np.clip(grey + rng.normal(0, 0.02, (100, 120, 1)), 0, 1).astype(np.float32)
    noisy = match_backdrop(light, grainy, rng, brightness=True)
    assert noisy[..., 0].std() > 5 * found[..., 0].std() + 1e-3
    warm = np.tile(np.array([0.6, 0.3, 0.1], np.float32), (100, 120, 1))
    tinted = match_backdrop(light, warm, rng, brightness=True)
    assert tinted[..., 0].mean() / tinted[..., 2].mean() > 5


def test_invalid_cutouts_are_refused(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    cutouts, photos = folders
    with pytest.raises(RecipeError, match="want backgrounds"):
        read_render_settings(str(write_recipe(tmp_path, cutouts, None)))
    with pytest.raises(SettingError, match="no folder"):
        open_cutouts(tmp_path / "nowhere")
    with pytest.raises(SettingError, match="no PNG"):
        open_cutouts(tmp_path)
    with pytest.raises(SourceError, match="no alpha"):
        load_cutout(photos / "0.png")
    Image.fromarray(np.zeros((9, 9, 4), np.uint8)).save(tmp_path / "clear.png")
    with pytest.raises(SourceError, match="transparent everywhere"):
        load_cutout(tmp_path / "clear.png")
    (tmp_path / "torn.png").write_bytes((cutouts / "cross.png").read_bytes()[:60])
    with pytest.raises(DmrlError, match="torn"):
        load_cutout(tmp_path / "torn.png")


def test_real_cutouts_are_read() -> None:
    if not CUTOUTS.is_dir():
        pytest.skip(f"no cut-outs in {CUTOUTS}")
    found = open_cutouts(CUTOUTS)
    assert len(found) == 2
    for cutout in found:
        assert 200 <= cutout.width_px <= 240
        assert 0 < cutout.light[..., 3].mean() < 0.5
