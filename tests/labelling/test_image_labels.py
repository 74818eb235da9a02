"""Labels in images: projection, sigmas, and whether a peer is in view."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dmrl.geometry.frames import Array, Camera, pixels_from_horizontal
from dmrl.labelling.image_labels import (
    MARGIN_SIGMAS,
    MIN_DEPTH_M,
    CameraOptions,
    label_anywhere,
    label_images,
)
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK, STATUS_UNCONVERGED

CAMERA = Camera(320, 224, 180.0, 190.0, 150.0, 100.0)
SHARP = CameraOptions(attitude_std_rad=1e-9)
EXACT = np.eye(3) * 1e-12


def build_positions(
    *xyz_m: tuple[float, float, float], covariance: Array = EXACT, status: int = STATUS_OK
) -> PeerPositions:
    """Return positions of a peer in metres, a nanosecond apart."""
    count = len(xyz_m)
    return PeerPositions(
        np.arange(count),
        np.array(xyz_m),
        np.tile(covariance, (count, 1, 1)),
        np.full(count, status),
    )


def build_labels(
    found: PeerPositions, look: CameraOptions = SHARP, camera: Camera = CAMERA, **tilt: float
) -> list[Any]:
    """Label an image at each position, with roll and pitch in radians."""
    attitude = np.tile([tilt.get("roll", 0.0), tilt.get("pitch", 0.0)], (len(found.time_ns), 1))
    return list(label_images("cf2", found, attitude, camera, look))


@pytest.mark.parametrize("left", [0.6, -0.6])
@pytest.mark.parametrize("up", [0.3, -0.5])
def test_a_peer_is_seen_in_its_quarter_of_the_image(left: float, up: float) -> None:
    (label,) = build_labels(build_positions((2.0, left, up)))
    assert label["u_px"] == pytest.approx(150 - 180 * left / 2)
    assert label["v_px"] == pytest.approx(100 - 190 * up / 2)
    assert label["depth_m"] == pytest.approx(2.0)
    assert (label["peer"], label["source"], label["status"]) == ("cf2", "estimate", STATUS_OK)


def test_roll_and_pitch_move_labels_in_the_documented_direction() -> None:
    (rolled,) = build_labels(build_positions((2.0, 0.4, 0.0)), roll=0.3)
    assert rolled["u_px"] == pytest.approx(150 - 180 * 0.4 * np.cos(0.3) / 2)
    assert rolled["v_px"] == pytest.approx(100 + 190 * 0.4 * np.sin(0.3) / 2)
    (pitched,) = build_labels(build_positions((2.0, 0.0, 0.0)), pitch=0.2)
    assert pitched["u_px"] == pytest.approx(150)
    assert pitched["v_px"] == pytest.approx(100 - 190 * np.tan(0.2))
    assert pitched["depth_m"] == pytest.approx(2 * np.cos(0.2))


@pytest.mark.parametrize("attitude_std_rad", [0.0, 0.03])
@pytest.mark.parametrize("spread_m", [0.0, 0.05])
def test_label_sigmas_match_sampled_positions_and_attitudes(
    attitude_std_rad: float, spread_m: float
) -> None:
    shape = np.array([[1.0, 0.3, 0.1], [0.3, 0.6, -0.2], [0.1, -0.2, 0.4]])
    found = build_positions((2.0, 0.5, -0.3), covariance=spread_m**2 * shape)
    (label,) = build_labels(found, CameraOptions(attitude_std_rad), roll=0.1, pitch=-0.2)
    rng, count = np.random.default_rng(0), 40_000
    drawn = rng.multivariate_normal(found.xyz_m[0], found.covariance[0], count)
    roll, pitch = rng.normal((0.1, -0.2), attitude_std_rad, (count, 2)).T
    uv, depth_m, _ = pixels_from_horizontal(drawn, roll, pitch, CAMERA)
    got = [label[f"sigma_{name}"] for name in ("u_px", "v_px", "depth_m")]
    assert got == pytest.approx([*uv.std(axis=0), depth_m.std()], rel=0.03, abs=1e-9)


def test_the_view_is_as_wide_and_as_high_as_the_image() -> None:
    right, below = (2.0, -150 / 180 * 2, 0.0), (2.0, 0.0, -150 / 190 * 2)
    seen = build_labels(build_positions(right, below))
    assert seen[0]["u_px"] == pytest.approx(300)
    assert seen[1] is None  # v is 250, and the image is 224 px high
    upright = build_labels(
        build_positions(right, below), camera=replace(CAMERA, width_px=224, height_px=320)
    )
    assert upright[0] is None
    assert upright[1]["v_px"] == pytest.approx(250)


@pytest.mark.parametrize(("axis", "edge"), [(0, 0.0), (0, 320.0), (1, 0.0), (1, 224.0)])
def test_peer_just_outside_the_image_is_labelled_within_its_sigma(axis: int, edge: float) -> None:
    sigma_px, outward = 6.0, 1 if edge else -1
    covariance = np.diag([0.0, (sigma_px * 2 / 180) ** 2, (sigma_px * 2 / 190) ** 2])
    for sigmas, named in ((MARGIN_SIGMAS - 0.1, True), (MARGIN_SIGMAS + 0.1, False)):
        uv = np.array([150.0, 100.0])
        uv[axis] = edge + outward * sigmas * sigma_px
        xyz = (2.0, -(uv[0] - 150) / 180 * 2, -(uv[1] - 100) / 190 * 2)
        (label,) = build_labels(build_positions(xyz, covariance=covariance))
        assert (label is not None) == named


def test_a_margin_is_no_wider_than_three_images() -> None:
    vague = np.diag([0.0, 100.0, 1e-12])
    at = [(2.0, -(u_px - 150) / 180 * 2, 0.0) for u_px in (320 + 3 * 320 - 5, 320 + 3 * 320 + 5)]
    near, far = build_labels(build_positions(*at, covariance=vague))
    assert near is not None
    assert far is None


def test_peer_behind_or_too_near_is_not_in_view() -> None:
    behind, near, ahead = build_labels(
        build_positions((-2.0, 0, 0), (MIN_DEPTH_M - 0.01, 0, 0), (0.06, 0, 0))
    )
    assert behind is None
    assert near is None
    assert ahead["depth_m"] == pytest.approx(0.06)


@pytest.mark.parametrize("status", [STATUS_AMBIGUOUS, STATUS_UNCONVERGED])
def test_peer_without_position_may_be_anywhere_in_the_image(status: int) -> None:
    behind, ahead = build_labels(build_positions((-3.0, 4.0, 0.0), (2.0, 0.0, 0.0), status=status))
    assert behind == label_anywhere("cf2", CAMERA, 5.0, status)
    assert (behind["u_px"], behind["v_px"], behind["depth_m"]) == (160, 112, 5.0)
    sigmas = [behind[f"sigma_{name}"] for name in ("u_px", "v_px", "depth_m")]
    assert sigmas == [320, 224, 5.0]
    assert (ahead["u_px"], ahead["status"]) == (pytest.approx(150), status)
    assert label_anywhere("cf2", CAMERA, 0.0)["depth_m"] == MIN_DEPTH_M
    assert label_anywhere("cf2", CAMERA, 0.0)["status"] == STATUS_UNCONVERGED


def test_labels_of_undistorted_images_ignore_the_lens() -> None:
    bent = replace(CAMERA, distortion=(-0.2,))
    (with_lens,) = build_labels(build_positions((2.0, 0.6, 0.0)), camera=bent)
    (without,) = build_labels(
        build_positions((2.0, 0.6, 0.0)), replace(SHARP, distorted=False), bent
    )
    assert without["u_px"] == pytest.approx(150 - 180 * 0.3)
    assert with_lens["u_px"] == pytest.approx(150 - 180 * 0.3 * (1 - 0.2 * 0.09))


def test_an_image_that_is_logged_late_was_taken_earlier() -> None:
    look = CameraOptions(0.01, cameras={"cf1": replace(CAMERA, delay_s=0.25)})
    logged_ns = np.array([10**9, 2 * 10**9])
    assert look.exposures_ns("cf1", logged_ns).tolist() == [750_000_000, 1_750_000_000]
    assert look.exposures_ns("cf2", logged_ns).tolist() == logged_ns.tolist()
