"""Estimated positions are compared with the truth: axes, covariances, missing estimates."""

from pathlib import Path

import numpy as np
import pytest

from dmrl import topics
from dmrl.evaluation.positions import document, judge, lasts_s
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK, message_class
from dmrl.recording import Provenance, RecordingWriter

SPREAD = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, 0.003], [0.002, 0.003, 0.25]])


def test_each_axis_is_compared_with_the_same_axis_of_truth(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    made = message_class("PeerPosition")
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(21):  # truth for 2 s; estimates from 0.5 s, halfway between its samples
            truth = made(x=1 + 0.1 * k, y=-2 + 0.3 * k, z=5.0)
            sink.write(k * 100_000_000, topics.TRUTH("cf1", "cf2"), truth)
            if k >= 5:
                status = STATUS_OK if k % 2 else STATUS_AMBIGUOUS
                at = {"x": 1 + 0.1 * (k + 0.5) + 0.3, "y": -2 + 0.3 * (k + 0.5) - 0.4, "z": 0.0}
                told = made(**at, covariance=SPREAD.ravel().tolist(), status=status)
                sink.write(k * 100_000_000 + 50_000_000, topics.POSITION("cf1", "cf2"), told)
    (pair,) = judge(path)
    assert pair.judged.error_m == pytest.approx(np.tile([0.3, -0.4], (15, 1)))
    assert pair.judged.covariance == pytest.approx(np.tile(SPREAD[:2, :2], (15, 1, 1)))
    assert pair.judged.time_s == pytest.approx(np.arange(15) * 0.1)
    true = np.hypot(1 + 0.1 * (5.5 + np.arange(15)), -2 + 0.3 * (5.5 + np.arange(15)))
    assert pair.judged.distance_m == pytest.approx(true)
    assert pair.judged.kept.tolist() == [k % 2 == 1 for k in range(5, 20)]
    assert (pair.without_truth, pair.true, pair.covered) == (1, 21, 15)
    made_of = document(path, [pair], 0.0)
    squared = np.array([0.3, -0.4]) @ np.linalg.inv(SPREAD[:2, :2]) @ [0.3, -0.4]
    assert made_of["pairs"][0]["nees"] == pytest.approx(squared)
    assert made_of["overall"]["covered"] == pytest.approx(15 / 21)
    assert lasts_s([pair]) == pytest.approx(1.4)
