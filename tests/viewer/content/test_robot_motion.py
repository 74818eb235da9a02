"""Poses, positions and ranges are parsed for drawing, with invalid ones left out."""

import warnings

import numpy as np
import pyarrow as pa
import pytest

from dmrl.viewer.content.robot_motion import parse_poses, parse_positions, parse_ranges

HOSTILE = [float("nan"), float("inf"), -float("inf"), 1e300, -1e300]


def make_transforms(xyz: list[list[float]], xyzw: list[list[float]]) -> pa.RecordBatch:
    """Return transforms of cf1 every 10 ns with these positions and quaternions."""
    parts = [
        {
            "parent_frame_id": "map",
            "child_frame_id": "cf1",
            "translation": dict(zip("xyz", place, strict=True)),
            "rotation": dict(zip("xyzw", turn, strict=True)),
        }
        for place, turn in zip(xyz, xyzw, strict=True)
    ]
    return pa.RecordBatch.from_pydict(
        {"log_time": np.arange(len(parts)) * 10, "transforms": [[part] for part in parts]}
    )


@pytest.mark.parametrize("bad", [*HOSTILE, 0.0])
def test_invalid_poses_are_omitted_without_warnings(bad: float) -> None:
    """One pose between valid ones is not finite or has a quaternion of length zero."""
    still, turn = [1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        places, turns = [still, [bad] * 3, still, still], [turn, [bad] * 4, turn, turn]
        found = parse_poses(make_transforms(places, turns))["cf1"]
        seen = found.to_parent(np.array([[0.5, 0.0, 0.0]] * 4), np.array([-5, 5, 10, 35]))
    assert seen[[0, 3]].tolist() == [[1.5, 2.0, 3.0]] * 2
    assert np.isnan(seen[[1, 2]]).all()


def test_quaternions_are_normalized() -> None:
    found = parse_poses(make_transforms([[0.0] * 3], [[0.0, 0.0, 2.0, 2.0]]))["cf1"]
    assert found.xyzw[0] == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])


@pytest.mark.parametrize("bad", HOSTILE)
def test_positions_and_ranges_that_cannot_be_drawn_are_no_numbers(bad: float) -> None:
    columns = {"log_time": [0, 10], "x": [1.0, bad], "y": [2.0, 2.0], "z": [3.0, 3.0]}
    columns |= {"covariance": [[1.0] * 9, [bad] * 9], "status": np.zeros(2, np.int32)}
    found = parse_positions(pa.RecordBatch.from_pydict(columns))
    assert found.xyz[0].tolist() == [1, 2, 3] and np.isnan(found.xyz[1, 0])
    assert (found.covariance[0] == 1).all() and np.isnan(found.covariance[1]).all()
    heard = pa.RecordBatch.from_pydict({"log_time": [0, 10], "range_m": [1.5, bad]})
    assert np.isnan(parse_ranges(heard).range_m).tolist() == [False, True]
