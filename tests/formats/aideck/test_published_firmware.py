"""The six numbers that the published firmware stores with each image."""

import numpy as np
import pytest

from dmrl.formats.aideck.published_firmware import MAX_DISTANCE_M, is_plausible, iter_samples
from dmrl.geometry.frames import AIDECK, Camera, pixels_from_horizontal

VALUES = (10.0, 20.0, 2.0, 0.3, -0.1, 2.5)


@pytest.mark.parametrize("place", range(6))
def test_numbers_that_no_drone_has_are_not_plausible(place: int) -> None:
    limit = 180.0 if place < 2 else MAX_DISTANCE_M
    for value, plausible in ((limit, True), (-limit, True), (limit + 0.1, False)):
        assert is_plausible([*VALUES[:place], value, *VALUES[place + 1 :]]) == plausible
    for value in (np.nan, np.inf, -limit - 0.1):
        assert not is_plausible([*VALUES[:place], value, *VALUES[place + 1 :]])


def test_degrees_nose_up_become_radians_nose_down() -> None:
    logged, attitude, position, heard, labels = iter_samples(7, "cf1", "cf2", VALUES, AIDECK)
    assert logged.fields == dict(zip(("roll", "pitch", "x", "y", "z", "d"), VALUES, strict=True))
    tilt = {"roll_rad": np.radians(10), "pitch_rad": -np.radians(20)}
    assert attitude.fields == pytest.approx(tilt)
    assert [position.fields[axis] for axis in "xyz"] == [2.0, 0.3, -0.1]
    assert position.fields["frame_id"] == "cf1/horizontal"
    assert heard.fields == {"range_m": 2.5}
    (uv,), _, _ = pixels_from_horizontal(
        np.array([VALUES[2:5]]), *(np.array([value]) for value in tilt.values()), AIDECK
    )
    (label,) = labels.fields["peers"]
    assert (label["u_px"], label["v_px"]) == pytest.approx(tuple(uv))
    assert {s.time_ns for s in (logged, attitude, position, heard, labels)} == {7}


def test_implausible_values_are_only_logged_and_zero_range_is_omitted() -> None:
    assert len(list(iter_samples(7, "cf1", "cf2", (*VALUES[:5], 1e9), AIDECK))) == 1
    kinds = [s.message for s in iter_samples(7, "cf1", "cf2", (*VALUES[:5], 0.0), None)]
    assert kinds[1:] == ["Attitude", "PeerPosition"]


def test_peer_out_of_view_has_no_label() -> None:
    for xyz in ((-2.0, 0.0, 0.0), (1.0, 5.0, 0.0), (1.0, 0.0, -5.0)):
        *_, labels = iter_samples(7, "cf1", "cf2", (0.0, 0.0, *xyz, 0.0), AIDECK)
        assert labels.fields["peers"] == []


def test_a_label_ends_at_the_picture_s_edges() -> None:
    """A label needs its centre inside the image and a depth over 5 cm.

    A level camera without distortion sees u = cx - fx y / x and v = cy - fy z / x.
    """
    camera = Camera(100, 80, 40.0, 50.0, 50.0, 40.0, ())

    def label(x: float, u: float, v: float) -> list[dict[str, float]]:
        place = (x, (50.0 - u) * x / 40.0, (40.0 - v) * x / 50.0)
        *_, labels = iter_samples(7, "cf1", "cf2", (0.0, 0.0, *place, 0.0), camera)
        found: list[dict[str, float]] = labels.fields["peers"]
        return found

    ((first),) = label(2.0, 10.0, 20.0)
    assert (first["u_px"], first["v_px"], first["depth_m"]) == pytest.approx((10, 20, 2))
    for u, v, count in (
        *((0.01, 40, 1), (-0.01, 40, 0), (99.99, 40, 1), (100.01, 40, 0)),
        *((50, 0.01, 1), (50, -0.01, 0), (50, 79.99, 1), (50, 80.01, 0)),
    ):
        assert len(label(2.0, u, v)) == count
    assert len(label(0.051, 50, 40)) == 1
    assert len(label(0.049, 50, 40)) == 0


def test_left_and_top_image_edges_are_inside() -> None:
    """All numbers are exact in floating point, so that the edges are hit exactly."""
    camera = Camera(128, 64, 32.0, 32.0, 64.0, 32.0, ())
    for u, v, count in ((0, 0, 1), (128, 32, 0), (64, 64, 0), (127, 63, 1)):
        place = (1.0, (64 - u) / 32, (32 - v) / 32)
        *_, labels = iter_samples(7, "cf1", "cf2", (0.0, 0.0, *place, 0.0), camera)
        assert len(labels.fields["peers"]) == count
