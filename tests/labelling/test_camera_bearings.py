"""Detections are converted to bearings and distances in the horizontal frame."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.model.bearings import to_bearing
from dmrl.geometry.frames import Camera, pixels_from_horizontal
from dmrl.labelling.camera_bearings import (
    DISTANCE_RATIO,
    MIN_DISTANCE_RATIO,
    add_bearings,
    detections_to_bearings,
)
from dmrl.labelling.observer_log import ObserverLog

from ..estimation.sighted_flights import build_still_pair

CAMERA = Camera(320, 224, 180.0, 180.0, 160.0, 112.0)
COUNT, STEP_NS, START_NS = 40, 100_000_000, 7_000_000_000
TIME_NS = START_NS + np.arange(COUNT) * STEP_NS
SWAY = np.sin(np.arange(COUNT) / 10)
TRUE_M = np.column_stack([2 + 0 * SWAY, 0.3 * SWAY, 0.1 + 0 * SWAY])
TILT = np.column_stack([0.25 * np.cos(SWAY), -0.15 + 0.05 * SWAY])


def simulate_log(sigma_m: float = 0.0, every: int = 1) -> ObserverLog:
    """Return a log with one exact detection in every ``every``-th image, none in the others."""
    uv, depth_m, _ = pixels_from_horizontal(TRUE_M, TILT[:, 0], TILT[:, 1], CAMERA)
    shown = np.arange(COUNT) % every == 0
    rows = np.column_stack([uv, depth_m, np.full(COUNT, sigma_m)])[shown]
    first = np.concatenate([[0], np.cumsum(shown)])
    nothing = np.zeros((COUNT, 3))
    return ObserverLog(
        "cf1", CAMERA, TIME_NS, TIME_NS, rows, first, TILT, nothing, nothing[:, 0], {}, []
    )


def test_detections_are_directions_in_the_horizontal_frame() -> None:
    found = detections_to_bearings(simulate_log(every=2), START_NS, 3.6, 0.015)
    assert found.time_s == pytest.approx(np.arange(0, COUNT, 2) * 0.1)
    assert found.bearing[:, 0] == pytest.approx(to_bearing(TRUE_M[::2]))
    wanted = [3.6 / 180, np.hypot(3.6 / 180, 0.015), DISTANCE_RATIO]
    assert found.std == pytest.approx(np.tile(wanted, (COUNT // 2, 1, 1)))


def test_depth_sigma_of_network_has_a_lower_limit() -> None:
    depth_m = simulate_log().detections[:, 2]
    assert detections_to_bearings(simulate_log(0.4), 0, 3.0, 0.01).std[:, 0, 2] == pytest.approx(
        0.4 / depth_m
    )
    assert (
        detections_to_bearings(simulate_log(1e-3), 0, 3.0, 0.01).std[..., 2] == MIN_DISTANCE_RATIO
    ).all()


def test_images_have_as_many_candidates_as_they_show() -> None:
    one = simulate_log(every=4)
    # The first image with a detection gets a second one.
    rows = np.concatenate([one.detections[:1], one.detections])
    first = one.first_row + (np.arange(COUNT + 1) > 0)
    both = replace(one, detections=rows, first_row=first)
    found = detections_to_bearings(both, START_NS, 3.0, 0.01)
    assert np.isfinite(found.bearing[..., 0]).sum(axis=1).tolist() == [2] + [1] * 9
    assert found.bearing[0, 0] == pytest.approx(found.bearing[0, 1])
    none = replace(one, detections=rows[:0], first_row=0 * first)
    assert len(detections_to_bearings(none, START_NS, 3.0, 0.01).time_s) == 0


def test_both_robots_of_a_pair_get_their_bearings() -> None:
    pair, _ = build_still_pair()
    sees = detections_to_bearings(simulate_log(), START_NS, 3.0, 0.01)
    pairs = add_bearings({("a", "b"): pair, ("b", "c"): pair}, {"b": sees})
    assert pairs["a", "b"].peer_bearings is sees and pairs["a", "b"].own_bearings is None
    assert pairs["b", "c"].own_bearings is sees and pairs["b", "c"].peer_bearings is None
    assert pairs["a", "b"].swap_robots().own_bearings is sees
