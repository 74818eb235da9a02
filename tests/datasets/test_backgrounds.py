"""Images of a dataset as render backgrounds, with their own robots inpainted."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.datasets.backgrounds import inpaint_hidden, open_backgrounds
from dmrl.errors import SettingError
from dmrl.images.codec import encode_png
from dmrl.stages import dataset

from .conftest import Record, build_peer, draw_noise

BOX = {"box_px": [16.0, 9.0, 25.0, 16.0]}


@pytest.mark.heavy
def test_robots_of_a_dataset_are_inpainted(record: Record, tmp_path: Path) -> None:
    filling = build_peer(box_px=[0.0, 0.0, 64.0, 48.0])
    recording = record(peers=[[build_peer(**BOX)], [], [filling], [build_peer()]])
    dataset.run([recording], tmp_path / "set", dataset.Settings())
    photos = open_backgrounds(tmp_path / "set")
    changed = (photos.load_photo(0) != draw_noise(0)).any(axis=-1)
    assert changed[9:16, 16:25].mean() > 0.95
    v, u = np.nonzero(changed)
    assert u.min() > 8
    assert u.max() < 34
    assert v.min() > 2
    assert v.max() < 24
    # The second image has no robot, the third only robot, and the robot of the fourth no box.
    assert (photos.load_photo(1) == draw_noise(1)).all()
    assert (photos.load_photo(2) == photos.load_photo(0)).all()


@pytest.mark.heavy
def test_a_dataset_whose_robots_have_no_box_is_refused(record: Record, tmp_path: Path) -> None:
    dataset.run([record()], tmp_path / "set", dataset.Settings())
    with pytest.raises(SettingError, match=r"no image for a background.*--backgrounds"):
        open_backgrounds(tmp_path / "set")


def test_hidden_pixels_are_inpainted_from_their_surroundings() -> None:
    rgb = np.full((64, 96, 3), (20, 120, 220), np.uint8)
    hidden = np.zeros((64, 96), bool)
    hidden[20:40, 30:60] = True
    rgb[hidden] = 255
    off = np.abs(inpaint_hidden(rgb, hidden).astype(int) - (20, 120, 220))
    assert off.max() <= 4  # rounding accumulates towards the middle


def test_background_photos_are_loaded_unchanged(tmp_path: Path) -> None:
    photo = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    (tmp_path / "a.png").write_bytes(encode_png(photo))
    assert (open_backgrounds(tmp_path).load_photo(0) == photo).all()


@pytest.mark.heavy
def test_rooms_are_generated_and_reproducible_by_index() -> None:
    photos = open_backgrounds(Path("rooms"))
    rooms = [photos.load_photo(k) for k in range(6)]
    assert {room.shape for room in rooms} == {(252, 360, 3)}
    assert (open_backgrounds(Path("rooms")).load_photo(3) == rooms[3]).all()
    assert len({room.tobytes() for room in rooms}) == 6
    # Bright walls and dark objects cover both ends of the grey scale.
    levels = np.stack(rooms).mean(axis=-1)
    assert (levels.reshape(6, -1).max(axis=1) > 100).all()
    assert (levels < 60).mean() > 0.02
