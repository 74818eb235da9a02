"""Positions of label texts, and the legend."""

import numpy as np
import pyarrow as pa
import pytest

from dmrl.viewer.drawing.archetypes import draw_detections
from dmrl.viewer.drawing.label_overlay import _place_texts
from dmrl.viewer.drawing.legend import _fit_names


def test_label_text_is_above_its_peer() -> None:
    tops = np.array([[100.0, 80.0], [100.0, 80.0]])
    places = _place_texts(tops, tops[:, 1], np.array([0, 1]), 320)
    assert places == pytest.approx(np.array([[100.0, 80 - 320 / 12]] * 2))


def test_label_texts_do_not_overlap() -> None:
    rng = np.random.default_rng(0)
    for count in range(2, 7):
        tops = rng.uniform([100, 0], [180, 120], (count, 2))
        places = _place_texts(tops, tops[:, 1], np.zeros(count, int), 320)
        assert (places[:, 1] >= 0).all()
        apart = abs(places[:, None] - places)[np.triu_indices(count, 1)]
        assert ((apart[:, 0] >= 80) | (apart[:, 1] >= 26)).all(), (tops, places)


def test_texts_of_two_estimates_do_not_overlap() -> None:
    # The text of the lower label would cover that of the upper one.
    tops = np.array([[100.0, 80.0], [110.0, 90.0]])
    places = _place_texts(tops, tops[:, 1], np.zeros(2, int), 320)
    assert abs(places[0, 1] - places[1, 1]) >= 320 / 12 - 0.5


def test_an_estimate_near_the_upper_edge_has_its_text_below_that_of_a_detection() -> None:
    tops, bottoms = np.array([[100.0, 15.0], [120.0, 20.0]]), np.array([30.0, 20.0])
    places = _place_texts(tops, bottoms, np.zeros(2, int), 320)
    assert places[1, 1] >= bottoms[0] + 320 / 12 - 0.5


def test_more_confident_of_overlapping_detections_keeps_its_text() -> None:
    # Position, pixels, and confidence of each detection of two equal images.
    near = [(100.0, 80.0, 0.5), (130.0, 90.0, 0.9), (130.0, 180.0, 0.6), (260.0, 90.0, 0.7)]
    found = [dict(zip(("u_px", "v_px", "confidence"), d, strict=True)) for d in near]
    rows = [{"threshold": 0.4, "detections": [{**d, "depth_m": 1.0} for d in found]}] * 2
    points, entity, weak = draw_detections("/a", "a", pa.RecordBatch.from_pylist(rows), 320)
    assert (points.path, entity.path, weak.path) == ("/a", "/a/texts", "/a/weak")
    (texts,) = (c for c in entity.columns if "labels" in str(c.component_descriptor()))
    told = ["conf 0.90, 1.00 m", "conf 0.60, 1.00 m", "conf 0.70, 1.00 m"]
    assert texts.as_arrow_array().to_pylist() == [told, told]


def test_names_of_a_legend_fit_or_are_shortened() -> None:
    assert _fit_names(["truth", "estimate", "old", "new"]) == ["truth", "estimate", "old", "new"]
    long = _fit_names(["truth", "estimate", "found-refined-101", "found-network-101"])
    assert long == ["truth", "estimate", "…refined…", "…network…"]
    assert _fit_names(["truth", "a" * 60]) == ["truth", "a" * 36 + "…"]
