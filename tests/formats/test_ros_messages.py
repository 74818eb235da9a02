"""Vectors of ROS messages in dmrl's frames."""

import numpy as np
import pytest

from dmrl.formats.ros_messages import _levelled, _turned_back

QUARTER = np.pi / 2


@pytest.mark.parametrize(
    ("angles", "body", "level"),
    [
        ((QUARTER, 0, 0), (0, 1, 0), (0, 0, 1)),  # rolled to the right, its left is up
        ((0, QUARTER, 0), (1, 0, 0), (0, 0, -1)),  # nose down
        ((QUARTER, QUARTER, 0), (0, 1, 0), (1, 0, 0)),
        ((QUARTER, QUARTER, 0), (0, 0, 1), (0, -1, 0)),
        ((0, 0, QUARTER), (1, 0, 0), (1, 0, 0)),  # its heading changes nothing here
    ],
)
def test_a_tilted_robot_s_vectors_are_levelled(
    angles: tuple[float, ...], body: tuple[float, ...], level: tuple[float, ...]
) -> None:
    got = _levelled(np.array(body), np.array(angles))
    assert got == pytest.approx(np.array(level), abs=1e-12)


def test_a_fixed_frame_s_vectors_are_turned_by_the_heading() -> None:
    left = np.array([0.3, -0.2, QUARTER])  # whatever the tilt
    ahead, up = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    assert _turned_back(ahead, left) == pytest.approx(np.array([1.0, 0.0, 0.0]), abs=1e-12)
    right = np.array([1.0, 0.0, 0.0])
    assert _turned_back(right, left) == pytest.approx(np.array([0.0, -1.0, 0.0]), abs=1e-12)
    assert _turned_back(up, left) == pytest.approx(up)
