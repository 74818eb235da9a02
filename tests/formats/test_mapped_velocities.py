"""Velocities of a CSV, turned from the frame that its table names."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.errors import SourceError
from dmrl.formats.crazyflie.log_block import TimeSeries
from dmrl.formats.files import mapped_csv
from dmrl.geometry.frames import camera_from_horizontal

ANGLE = st.floats(-1.4, 1.4)


@given(ANGLE, ANGLE, st.floats(-3, 3), st.lists(st.floats(-2, 2), min_size=3, max_size=3))
def test_a_velocity_of_any_frame_is_turned_into_the_world_s(
    roll: float, pitch: float, yaw: float, v: list[float]
) -> None:
    time_ns = np.arange(3)
    attitude = TimeSeries(time_ns, np.tile([roll, pitch, yaw], (3, 1)))
    values = {f"v{axis}": np.full(3, part) for axis, part in zip("xyz", v, strict=True)}
    c, s = np.cos(yaw), np.sin(yaw)
    heading = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    level = {"world": heading.T, "horizontal": np.eye(3)}
    level["body"] = camera_from_horizontal(roll, pitch).T
    for frame, turned in level.items():
        found = mapped_csv._rotate_to_world(Path("a"), time_ns, values, frame, attitude)
        assert list(found) == [f"stateEstimate.v{axis}" for axis in "xyz"]
        got = np.array(list(found.values()))
        assert got == pytest.approx(np.tile((heading @ turned @ v)[:, None], 3), abs=1e-9)


def test_a_velocity_that_cannot_be_turned_says_what_it_wants() -> None:
    at, still = np.arange(3), np.zeros(3)
    level = TimeSeries(at, np.zeros((3, 3)))
    values = {"vx": still, "vy": still}
    for frame, attitude, wanted in (
        ("body", level, r"body needs \[vz\], \[roll\]"),
        ("body", None, r"body needs \[vz\], \[roll\]"),
        ("horizontal", None, "horizontal needs an attitude"),
    ):
        with pytest.raises(SourceError, match=wanted):
            mapped_csv._rotate_to_world(Path("a"), at, values, frame, attitude)
    for frame, attitude in (("world", None), ("horizontal", level)):
        found = mapped_csv._rotate_to_world(Path("a"), at, values, frame, attitude)
        assert len(found) == 2
    with pytest.raises(SourceError, match="body needs"):
        mapped_csv._rotate_to_world(Path("a"), at, {**values, "vz": still}, "body", None)
    assert mapped_csv._rotate_to_world(Path("a"), at, {**values, "vz": still}, "body", level)
