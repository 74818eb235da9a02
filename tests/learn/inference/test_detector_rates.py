"""Rates of detections and false detections, measured for the tracker."""

import json
from pathlib import Path

import numpy as np
import pytest

from dmrl.deploy.detector import RATE_FIELDS, read_rates
from dmrl.errors import ModelError
from dmrl.estimation.tracking.detector_rates import DetectorRates
from dmrl.learn.inference.detection_metrics import ScoredDetections, score_detections
from dmrl.learn.inference.detector_rates import measure_rates
from dmrl.learn.inference.matching import Points
from dmrl.learn.pretrained import resolve_model_path


def simulate_scored(images: int = 4000) -> ScoredDetections:
    """Simulate one peer an image, at 0.75 or 1.75 m, and one false detection in two images.

    Peers are found in 80 % of images at 0.75 m and 40 % at 1.75 m. Logits of true and false
    detections are normal around 1 and -1 with unit variance, so their log ratio is 2 logit.
    """
    rng = np.random.default_rng(0)
    depth_m = np.where(np.arange(images) % 2, 1.75, 0.75)
    every = np.arange(images)
    labels = Points(every, np.full(images, 100.0), np.full(images, 100.0), depth_m, np.ones(images))
    seen = every[rng.random(images) < np.where(depth_m < 1, 0.8, 0.4)]
    alarms = every[rng.random(images) < 0.5]
    image = np.concatenate([seen, alarms])
    u_px = np.repeat([100.0, 200.0], [len(seen), len(alarms)])
    logit = rng.normal(np.repeat([1.0, -1.0], [len(seen), len(alarms)]))
    order = np.lexsort((-logit, image))
    found = Points(image, u_px, np.full(len(image), 100.0), np.ones(len(image)), logit)
    found = Points(
        *(getattr(found, n)[order] for n in ("image", "u_px", "v_px", "depth_m")),
        (1 / (1 + np.exp(-logit[order]))),
    )
    return score_detections(images, labels, found)


def test_detector_rates_are_recovered_from_samples() -> None:
    rates = measure_rates(simulate_scored())
    assert rates is not None
    assert set(rates) == set(RATE_FIELDS)
    assert rates["distance_m"] == [0.75, 1.75]
    # Confidences below 0.05, a logit of -2.9, do not count: 3 % of the false detections.
    assert rates["detected"] == pytest.approx([0.8, 0.4], abs=0.03)
    assert rates["false_per_image"] == pytest.approx(0.485, abs=0.03)
    ratio = DetectorRates(**rates).log_ratio(1 / (1 + np.exp(-np.array([-1.0, 0.0, 1.0]))))
    assert ratio == pytest.approx([-2.0, 0.0, 2.0], abs=0.2)


def test_few_detections_give_no_rates() -> None:
    assert measure_rates(simulate_scored(40)) is None


def test_rates_are_read_from_the_shipped_model_and_are_optional(
    tmp_path: Path,
) -> None:
    rates = read_rates(resolve_model_path(Path("dmrl-nano")))
    assert rates is not None
    assert DetectorRates(**rates).detected_share(np.array([0.75, 1.75])).tolist() == [
        rates["detected"][1],
        rates["detected"][3],
    ]
    (tmp_path / "model.json").write_text("{}")
    assert read_rates(tmp_path) is None


@pytest.mark.parametrize("change", [{"slope": "x"}, {"detected": [0.1]}, {"offset": None}])
def test_damaged_rates_are_refused(tmp_path: Path, change: dict[str, object]) -> None:
    rates = read_rates(resolve_model_path(Path("dmrl-nano")))
    assert rates is not None
    (tmp_path / "model.json").write_text(json.dumps({"rates": {**rates, **change}}))
    with pytest.raises(ModelError, match="is damaged"):
        read_rates(tmp_path)
