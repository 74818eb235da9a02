"""Two models are compared on their common images, with intervals of the differences."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from dmrl.evaluation.comparison import HEADERS, align_images, build_rows, compare_models, note
from dmrl.evaluation.detections import ImageKey, LabelledDetections
from dmrl.learn.inference.matching import Points

IMAGES = 200


def build_evaluated(name: str, labels: Points, error_px: np.ndarray) -> LabelledDetections:
    """Return labelled detections whose u is off by an error in each image."""
    found = replace(labels, u_px=labels.u_px + error_px)
    at = [ImageKey(Path(f"{name}.mcap"), "cf1", k) for k in range(len(labels))]
    return LabelledDetections(at, labels, found, 0.5)


def draw_labels(seed: int = 0) -> Points:
    """Draw one label an image."""
    rng = np.random.default_rng(seed)
    u_px, v_px = rng.uniform(20, 200, (2, IMAGES))
    return Points(np.arange(IMAGES), u_px, v_px, rng.uniform(0.3, 2, IMAGES), np.ones(IMAGES))


def test_an_error_common_to_both_is_not_in_the_interval_of_the_difference() -> None:
    common = np.random.default_rng(1).gamma(2.0, 2.0, IMAGES)
    labels = draw_labels()
    both = align_images(
        build_evaluated("a", labels, common), build_evaluated("b", labels, common + 0.5)
    )
    assert both is not None
    made = compare_models(both, (0.5, 0.5), draws=200, seed=3)
    mean = made["figures"]["mean_px"]
    assert np.isclose(mean["second"] - mean["first"], 0.5)
    assert np.allclose([mean["difference"][k] for k in ("value", "low", "high")], 0.5)
    rows = {row[0]: row[1:] for row in build_rows(made)}
    assert rows["mean error, px"][2:] == ["+0.5 [+0.5, +0.5]", "yes"]
    made["figures"]["r2_depth"]["second"] = -30.0
    row = next(row[1:] for row in build_rows(made) if row[0] == "R2 of depth")
    assert row == ["1.00", "< -1", "-", ""]
    assert rows["recall"][3] == "" and len(rows["recall"]) == len(HEADERS) - 1
    assert "first: a.mcap, second: b.mcap; 200 common images" in note(made)
    assert note(made).endswith("Precision, recall and F1 are at confidence 0.5 and 0.5")
    made["figures"]["r2_depth"]["second"] = 1.0
    assert compare_models(both, (0.5, 0.5), draws=200, seed=3) == made


def test_common_images_alone_are_compared_in_one_order() -> None:
    labels = draw_labels()
    first = build_evaluated("a", labels, np.zeros(IMAGES))
    turned = np.arange(IMAGES)[::-1][: IMAGES // 2]
    part = Points(np.arange(len(turned)), *(c[turned] for c in labels._columns()))
    second = build_evaluated("b", part, np.full(len(turned), 3.0))
    second = replace(second, at=[ImageKey(Path("b.mcap"), "cf1", int(k)) for k in turned])
    both = align_images(first, second)
    assert both is not None and [one.images for one in both] == [IMAGES // 2] * 2
    assert [at.time_ns for at in both[0].at] == [at.time_ns for at in both[1].at]
    made = compare_models(both, (0.5, 0.5), draws=20, seed=0)
    assert np.isclose(made["figures"]["mean_px"]["difference"]["value"], 3.0)


def test_recordings_with_different_labels_or_times_are_not_compared() -> None:
    zeros = np.zeros(IMAGES)
    first = build_evaluated("a", draw_labels(), zeros)
    assert align_images(first, build_evaluated("b", draw_labels(1), zeros)) is None
    later = build_evaluated("b", draw_labels(), zeros)
    later = replace(later, at=[at._replace(time_ns=at.time_ns + IMAGES) for at in later.at])
    assert align_images(first, later) is None
