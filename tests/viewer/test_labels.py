"""Where the texts of labels stand, and what a legend says."""

import numpy as np
import pytest

from dmrl.viewer.labels import _text_places
from dmrl.viewer.legend import _fitting


def test_a_text_stands_above_its_peer() -> None:
    places = _text_places(np.array([[100.0, 80.0], [100.0, 80.0]]), np.array([0, 1]), 320)
    assert places == pytest.approx(np.array([[100.0, 80 - 320 / 12]] * 2))


def test_no_text_stands_on_another() -> None:
    rng = np.random.default_rng(0)
    for count in range(2, 7):
        tops = rng.uniform([100, 0], [180, 120], (count, 2))
        places = _text_places(tops, np.zeros(count, int), 320)
        assert (places[:, 1] >= 0).all()
        apart = abs(places[:, None] - places)[np.triu_indices(count, 1)]
        assert ((apart[:, 0] >= 80) | (apart[:, 1] >= 26)).all(), (tops, places)


def test_texts_of_two_estimates_at_other_heights_do_not_meet() -> None:
    # The upper one's text has its own place, the lower one's would stand on it.
    tops = np.array([[100.0, 80.0], [110.0, 90.0]])
    places = _text_places(tops, np.zeros(2, int), 320)
    assert abs(places[0, 1] - places[1, 1]) >= 320 / 12 - 0.5


def test_names_of_a_legend_fit_or_are_shortened() -> None:
    assert _fitting(["truth", "estimate", "old", "new"]) == ["truth", "estimate", "old", "new"]
    long = _fitting(["truth", "estimate", "found-refined-101", "found-network-101"])
    assert long == ["truth", "estimate", "…refined…", "…network…"]
    assert _fitting(["truth", "a" * 60]) == ["truth", "a" * 36 + "…"]
