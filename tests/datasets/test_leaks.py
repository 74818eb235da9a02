"""Leaks from train to test splits: similar images, times, poses and recordings."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from dmrl.card.leakage import count_near_in_time, count_same_poses
from dmrl.datasets import open_dataset
from dmrl.datasets.writing.near_duplicates import NEAR_DUPLICATE_BITS, compute_perceptual_hash
from dmrl.stages.dataset import Settings, run

from .conftest import Record, build_peer

pytestmark = pytest.mark.heavy


def draw_scene(seed: int) -> Image.Image:
    """Draw an image of large smooth patches, as photographs have."""
    rough = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)
    return Image.fromarray(rough).resize((320, 224), Image.Resampling.BICUBIC)


def compute_hash_distance(a: Image.Image, b: Image.Image) -> int:
    """Return the number of bits in which the perceptual hashes of two images differ."""
    return (
        compute_perceptual_hash(np.asarray(a)) ^ compute_perceptual_hash(np.asarray(b))
    ).bit_count()


def test_near_duplicate_hash_ignores_brightness_noise_and_scale() -> None:
    for seed in range(20):
        picture = draw_scene(seed)
        noise = np.random.default_rng(seed).normal(0, 4, (224, 320, 3))
        noisy = Image.fromarray(np.clip(np.asarray(picture) * 0.8 + noise, 0, 255).astype(np.uint8))
        assert compute_hash_distance(picture, noisy) <= NEAR_DUPLICATE_BITS
        assert (
            compute_hash_distance(picture, picture.filter(ImageFilter.GaussianBlur(2)))
            <= NEAR_DUPLICATE_BITS
        )
        assert compute_hash_distance(picture, picture.resize((160, 112))) <= NEAR_DUPLICATE_BITS


def test_near_duplicate_hash_ignores_a_small_drone_but_not_the_scene() -> None:
    for seed in range(20):
        picture, moved = draw_scene(seed), np.asarray(draw_scene(seed)).copy()
        moved[100:112, 200:216] = 10
        assert compute_hash_distance(picture, Image.fromarray(moved)) <= NEAR_DUPLICATE_BITS
        assert compute_hash_distance(picture, draw_scene(seed + 100)) > 2 * NEAR_DUPLICATE_BITS


def test_test_images_that_look_like_one_in_train_are_counted(
    record: Record, tmp_path: Path
) -> None:
    path = record(split={"train": "[[0, 250000000]]", "test": "[[300000000, 600000000]]"}, seed=3)
    twin = record("twin.mcap", split={"test": "[[0, 600000000]]"}, seed=3)
    run([path, twin], tmp_path / "out", Settings())
    text = (tmp_path / "out" / "README.md").read_text()
    assert "3 images of a test split have the pixels of one in train, 3 are near" in text


def test_times_and_poses_shared_with_train_are_counted(record: Record, tmp_path: Path) -> None:
    spans = {"train": "[[0, 50000000]]", "test": "[[100000000, 600000000]]"}
    poses = [
        [build_peer(u_px=20.49)],
        [build_peer(u_px=20.51)],
        [build_peer(u_px=22.0)],
        [build_peer(depth_m=1.7)],
    ]
    path = record(peers=poses, split=spans)
    run([path], tmp_path / "out", Settings())
    opened = open_dataset(tmp_path / "out")
    train, test = opened.split("train"), opened.split("test")
    assert count_near_in_time(test, train) == 3
    assert count_same_poses(test, train) == (1, 3)
    text = (tmp_path / "out" / "README.md").read_text()
    assert "test and train share `flight.mcap`" in text
    assert "3 of 3 images of test were taken within 1 s" in text
    assert "1 of 3 labels of test are within 1 px and 1 cm" in text


def test_separate_recordings_have_no_leaks(record: Record, tmp_path: Path) -> None:
    one = record(split={"train": "[[0, 900000000]]"})
    other = record(
        "other.mcap", [[build_peer(u_px=50.0)]], seed=1, split={"test": "[[0, 900000000]]"}
    )
    run([one, other], tmp_path / "out", Settings())
    text = (tmp_path / "out" / "README.md").read_text()
    assert "test and train share no recording" in text
    assert "0 of 1 images of test were taken" in text and "0 of 1 labels of test are" in text
