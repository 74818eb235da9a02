"""Positions corrected by detections."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.geometry.frames import Array, Camera, pixels_from_horizontal
from dmrl.labelling.labels import Positions
from dmrl.labelling.sight import Sight
from dmrl.labelling.sighted import sighted
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK

CAMERA = Camera(320, 224, 180.0, 180.0, 160.0, 112.0)
COUNT, STEP_NS = 40, 100_000_000
TIME_NS = np.arange(COUNT) * STEP_NS
TRUE_M = np.column_stack([2 + 0 * TIME_NS, 0.3 * np.sin(TIME_NS / 1e9), 0.1 + 0 * TIME_NS])
TILT = np.column_stack([0.1 * np.cos(TIME_NS / 1e9), 0.05 * np.sin(TIME_NS / 1e9)])


def known(off_m: Array, status: int = STATUS_OK) -> Positions:
    covariance = np.tile(np.diag([0.09, 0.09, 0.01]), (COUNT, 1, 1))
    return Positions(TIME_NS, TRUE_M + off_m, covariance, np.full(COUNT, status, np.int8))


def seen(every: int = 1, shift_ns: int = 0) -> Sight:
    uv, depth_m, _ = pixels_from_horizontal(TRUE_M, *TILT.T, CAMERA)
    kept = np.arange(0, COUNT, every)
    detections = np.column_stack([uv, depth_m, np.zeros(COUNT)])[kept]
    times_ns = TIME_NS[kept] + shift_ns
    return Sight(
        "cf1",
        CAMERA,
        times_ns,
        times_ns,
        detections,
        np.arange(len(kept) + 1),
        TILT[kept],
        np.zeros((len(kept), 3)),
        np.zeros(len(kept)),
        {},
        [],
    )


def test_what_was_seen_moves_positions_to_where_it_was() -> None:
    before = known(np.array([0.0, 0.25, 0.0]))
    after, used = sighted(seen(every=2), before, 3.0)
    assert used == COUNT // 2
    assert np.abs(after.xyz_m - TRUE_M)[:, 1].mean() < 0.08
    assert (after.covariance[:, 1, 1] < 0.3 * before.covariance[:, 1, 1]).all()
    assert (after.time_ns == before.time_ns).all()
    assert (after.status == before.status).all()


def test_a_vaguer_detector_moves_them_less() -> None:
    before = known(np.array([0.0, 0.25, 0.0]))
    sharp, vague = (sighted(seen(every=8), before, std_px)[0] for std_px in (2.0, 60.0))
    assert (sharp.covariance[:, 1, 1] < vague.covariance[:, 1, 1]).all()


def test_positions_that_are_not_ok_and_images_without_one_are_left_alone() -> None:
    open_ones = known(np.array([0.0, 0.25, 0.0]), STATUS_AMBIGUOUS)
    assert sighted(seen(), open_ones, 3.0) == (open_ones, 0)
    between = known(np.array([0.0, 0.25, 0.0]))
    assert sighted(seen(shift_ns=STEP_NS // 2), between, 3.0) == (between, 0)
    status = np.where(np.arange(COUNT) < 20, STATUS_AMBIGUOUS, STATUS_OK).astype(np.int8)
    mixed = replace(between, status=status)
    after, used = sighted(seen(), mixed, 3.0)
    assert used == 20
    assert (after.xyz_m[:20] == mixed.xyz_m[:20]).all()
    assert np.abs(after.xyz_m[25:] - TRUE_M[25:])[:, 1].max() == pytest.approx(0, abs=0.1)


def test_detections_are_turned_by_the_attitude_of_their_image() -> None:
    steep = np.tile([0.25, -0.15], (COUNT, 1))
    uv, depth_m, _ = pixels_from_horizontal(TRUE_M, *steep.T, CAMERA)
    detections = np.column_stack([uv, depth_m, np.zeros(COUNT)])
    tilted = replace(seen(), detections=detections, attitude_rad=steep)
    after, used = sighted(tilted, known(np.array([0.0, 0.1, 0.0])), 3.0)
    assert used == COUNT
    assert np.abs(after.xyz_m - TRUE_M).max() < 0.02
