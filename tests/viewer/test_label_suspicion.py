"""The label desk sorts images by the suspicion that their labels are wrong."""

from typing import Any

import numpy as np
import pytest
from numpy.random import Generator

from dmrl.viewer.label_suspicion import score_suspicion

SIZE_PX = (320, 224)
IMAGES = 200
Image = tuple[list[dict[str, float]], list[dict[str, float]]]


def place(u_px: float, v_px: float, confidence: float = 0.0, **fields: float) -> dict[str, float]:
    """Return the fields of a label or a detection."""
    place = {"u_px": u_px, "v_px": v_px, "confidence": confidence}
    return place | {"sigma_u_px": 0.0, "sigma_v_px": 0.0} | fields


def draw_image(rng: Generator, confidence: float, depth_m: float, found: bool = True) -> Image:
    """Return the label of an image, which is correct, and the detections of a network."""
    u_px, v_px = rng.uniform(20, SIZE_PX[0] - 20), rng.uniform(20, SIZE_PX[1] - 20)
    seen = [place(*rng.uniform((0, 0), SIZE_PX), 0.01 + 0.02 * rng.random(), depth_m=0.5)]
    if found:
        near = u_px + rng.normal(), v_px + rng.normal()
        seen.append(place(*near, confidence, depth_m=depth_m * np.exp(0.1 * rng.normal())))
    return [place(u_px, v_px, depth_m=depth_m)], seen


def draw_images(confidence: float, depth_m: float = 1.0) -> list[Image]:
    """Return images with correct labels; the network misses one robot in ten."""
    rng = np.random.default_rng(1)
    return [draw_image(rng, confidence, depth_m, k % 10 > 0) for k in range(IMAGES)]


def move_label(image: Image, by_px: float) -> Image:
    """Return an image with its label moved sideways."""
    (label,), found = image
    return [label | {"u_px": label["u_px"] + (by_px if label["u_px"] < 160 else -by_px)}], found


def rank(images: list[Image]) -> list[int]:
    """Return the numbers of the images, the most suspicious first."""
    return np.argsort(-score_suspicion(images, SIZE_PX), kind="stable").tolist()


@pytest.mark.parametrize("confidence", [0.05, 0.9])
@pytest.mark.parametrize("by_px", [20.0, 100.0])
def test_moved_labels_come_first_however_faint_the_network_sees(
    confidence: float, by_px: float
) -> None:
    images = draw_images(confidence)
    moved = [3, 57, 111, 199]
    for k in moved:
        images[k] = move_label(images[k], by_px)
    assert sorted(rank(images)[:4]) == moved


@pytest.mark.heavy
def test_a_label_without_a_detection_says_more_where_the_network_finds_all() -> None:
    rng = np.random.default_rng(1)
    near = [draw_image(rng, 0.9, 0.5, found=k > 0) for k in range(IMAGES)]
    far = [draw_image(rng, 0.9, 2.0, found=k % 2 > 0) for k in range(IMAGES)]
    scores = score_suspicion(near + far, SIZE_PX)
    assert scores[0] > 1.5 * np.median(scores[IMAGES::2])


def test_a_moved_label_counts_more_than_a_missing_one_and_that_more_than_a_right_one() -> None:
    images = draw_images(0.9)
    right, moved, missing = 1, 2, 3
    images[moved] = move_label(images[moved], 40)
    images[missing] = [], images[missing][1]
    scores = score_suspicion(images, SIZE_PX)
    assert scores[moved] > scores[missing] > scores[right]
    assert ((scores >= 0) & (scores <= 1)).all()


@pytest.mark.heavy
def test_a_label_of_large_sigma_is_not_contradicted_by_a_detection_beside_it() -> None:
    images = draw_images(0.9)
    images[2] = move_label(images[2], 40)
    before = score_suspicion(images, SIZE_PX)[2]
    images[2][0][0].update(sigma_u_px=20.0, sigma_v_px=20.0)
    assert score_suspicion(images, SIZE_PX)[2] < before / 10


@pytest.mark.parametrize(
    ("labels", "found"),
    [
        ([], []),
        ([place(50, 50)], []),
        ([place(50, 50)], [place(52, 51, 0.9)]),
        ([place(-900, 50, depth_m=1.0)], [place(52, 51, 1.0, depth_m=0.0)]),
        ([place(50, 50, sigma_u_px=np.inf, depth_m=np.inf)], [place(52, 51, 0.0, depth_m=1.0)]),
        ([place(50, 50, sigma_u_px=np.nan)], [place(52, 51, 0.5, depth_m=np.nan)]),
    ],
)
def test_any_image_alone_has_a_score(labels: list[Any], found: list[Any]) -> None:
    assert 0 <= score_suspicion([(labels, found)], SIZE_PX)[0] <= 1


def test_without_images_there_are_no_scores() -> None:
    assert len(score_suspicion([], SIZE_PX)) == 0


def test_without_labels_the_surest_detections_come_first() -> None:
    images: list[Image] = [([], [place(50, 50, confidence)]) for confidence in (0.2, 0.9, 0.5)]
    assert rank(images) == [1, 2, 0]
