"""Camera observations of peers: predicted pixels and matched detections."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.calibration.extrinsics import MAX_SQUARED_RESIDUAL, _mean_misfit
from dmrl.estimation.calibration.noise import Noise
from dmrl.estimation.calibration.observations import (
    CalibrationFlight,
    PeerPath,
    match_detections,
    median_residual_px,
    pixel_residuals,
    predict_pixels,
    with_mount,
)
from dmrl.geometry.frames import AIDECK, Array, pixels_from_horizontal

TIME_S = np.arange(0, 10, 0.1)
XYZ = np.column_stack([2 + 0 * TIME_S, 0.08 * TIME_S - 0.4, 0.02 * TIME_S])
SPREAD = np.array([[0.01, 0.002, 0.0], [0.002, 0.02, 0.001], [0.0, 0.001, 0.004]])
PATH = PeerPath(TIME_S, XYZ, np.tile(SPREAD, (len(TIME_S), 1, 1)))
ATTITUDE = np.column_stack([0.01 * TIME_S, -0.02 * TIME_S])
CAMERA = replace(AIDECK, mount_rad=(0.02, -0.03, 0.05), delay_s=0.25)
IMAGES_S = np.array([1.0, 2.0, 3.05, 4.0])


def build_flight(image: list[int], uv: Array) -> CalibrationFlight:
    """Return a flight with these detections, given by number of image and (N, 2) pixels."""
    return CalibrationFlight(IMAGES_S, np.array(image), uv, TIME_S, ATTITUDE, {"cf2": PATH})


def compute_true_pixels() -> Array:
    """Return (4, 2) pixels of the peer at the exposures, 0.25 s before the image stamps."""
    at_s = IMAGES_S - 0.25
    xyz = np.column_stack([2 + 0 * at_s, 0.08 * at_s - 0.4, 0.02 * at_s])
    uv, _, _ = pixels_from_horizontal(xyz, 0.01 * at_s, -0.02 * at_s, CAMERA)
    return uv


def test_predicted_pixels_use_the_exposure_time() -> None:
    uv, jacobian = predict_pixels(build_flight([], np.zeros((0, 2))), CAMERA, PATH, IMAGES_S)
    assert uv == pytest.approx(compute_true_pixels(), abs=1e-6)
    assert jacobian.shape == (4, 3, 5)
    assert with_mount(AIDECK, np.array([0.02, -0.03, 0.05, 0.25])) == CAMERA


def test_path_covers_times_between_near_samples() -> None:
    times = np.array([0.0, 0.1, 0.2, 0.44, 0.7, 0.8])
    path = PeerPath(times, XYZ[:6], np.stack([k * np.eye(3) for k in range(6)]))
    at_s = np.array([-0.1, 0.0, 0.05, 0.3, 0.5, 0.75, 0.8, 0.9])
    assert path.covers(at_s).tolist() == [False, False, True, True, False, True, True, False]
    assert path.interpolate_at(np.array([0.32]))[0] == pytest.approx((XYZ[2] + XYZ[3]) / 2)
    assert path.nearest_covariance(at_s)[:, 0, 0].tolist() == [0, 0, 1, 3, 4, 5, 5, 5]


def test_nearest_detection_within_the_radius_is_matched() -> None:
    uv = compute_true_pixels()
    off = np.array([[3.0, 0], [0, -2.0], [90.0, 0], [0, 9.0], [0, 30.5]])
    here = build_flight([0, 0, 1, 2, 3], uv[[0, 0, 1, 2, 3]] + off)
    found = match_detections([(here, PATH)], CAMERA, 30.0, Noise())
    assert found.time_s.tolist() == [1.0, 3.05]
    assert found.uv == pytest.approx(uv[[0, 2]] + off[[1, 3]])
    assert (found.expected, found.view.tolist()) == (4, [0, 0])
    wide = match_detections([(here, PATH)], CAMERA, 30.5, Noise())
    assert len(wide.time_s) == 3
    values = np.array([*CAMERA.mount_rad, CAMERA.delay_s])
    assert pixel_residuals([(here, PATH)], AIDECK, found, values) == pytest.approx(
        off[[1, 3]], abs=1e-6
    )
    assert median_residual_px([(here, PATH)], AIDECK, found, values) == pytest.approx(5.5)
    outside = replace(PATH, xyz_m=XYZ * [1, 1, 0] + [0, 0, 5.0])
    assert match_detections([(here, outside)], CAMERA, 900.0, Noise()).expected == 0


def test_expected_count_needs_a_path_at_the_exposure_time() -> None:
    """The path lasts from 0 to 9.9 s, and images are stamped 0.25 s after the exposure."""
    one = build_flight([2], np.array([[178.0, 91.0]]))
    late = replace(one, image_s=np.array([0.1, 0.2, 5.0, 10.0]))
    assert match_detections([(late, PATH)], CAMERA, 30.0, Noise()).expected == 2


def test_whitened_errors_have_unit_covariance() -> None:
    here = build_flight([0, 1, 2, 3], compute_true_pixels())
    noise = Noise(5.0, 0.02)
    found = match_detections([(here, PATH)], CAMERA, 30.0, noise)
    rng, at_s = np.random.default_rng(0), IMAGES_S[1] - 0.25
    centre = PATH.interpolate_at(np.array([at_s]))[0]
    xyz = rng.multivariate_normal(centre, SPREAD, 20_000)
    roll, pitch = rng.normal([[0.01 * at_s], [-0.02 * at_s]], 0.02, (2, 20_000))
    uv, _, _ = pixels_from_horizontal(xyz, roll, pitch, CAMERA)
    error = uv + rng.normal(0, 5.0, uv.shape) - compute_true_pixels()[1]
    assert np.cov(found.whiten[1] @ error.T) == pytest.approx(np.eye(2), abs=0.05)


def test_thinned_flight_keeps_detections_of_kept_images() -> None:
    uv = np.arange(10.0).reshape(5, 2)
    thin = build_flight([0, 1, 2, 2, 3], uv).thin_images(2)
    assert thin.image_s.tolist() == [1.0, 3.05]
    assert thin.image.tolist() == [0, 1, 1]
    assert thin.uv.tolist() == uv[[0, 2, 3]].tolist()
    assert build_flight([0, 1, 2, 2, 3], uv).thin_images(4).image.tolist() == [0, 1, 2, 2, 3]


def test_smoothing_removes_attitude_noise_and_keeps_motion() -> None:
    at_s = np.arange(0, 5, 0.01)
    slow = np.column_stack([0.2 * np.sin(at_s), 0.1 * np.cos(2 * at_s)])
    noise = np.random.default_rng(0).normal(0, 0.02, slow.shape)
    rough = replace(build_flight([], np.zeros((0, 2))), attitude_s=at_s, attitude_rad=slow + noise)
    for added, most_rad in ((noise, 0.6 * 0.02), (0 * noise, 0.002)):
        found = replace(rough, attitude_rad=slow + added).smooth_attitude()
        left = [
            np.interp(at_s, found.attitude_s, one) - wanted
            for one, wanted in zip(found.attitude_rad.T, slow.T, strict=True)
        ]
        assert np.std(left, axis=1).max() < most_rad


def test_smoothing_keeps_attitude_steps() -> None:
    at_s, rng = np.arange(0, 60, 0.01), np.random.default_rng(1)
    since_s = at_s % 1.5
    true = np.column_stack([0.1 * np.exp(-since_s / 0.25), -0.05 * np.exp(-since_s / 0.25)])
    noise = rng.normal(0, 0.005, true.shape)
    here = build_flight([], np.zeros((0, 2)))
    left = (
        replace(here, attitude_s=at_s, attitude_rad=true + noise).smooth_attitude().attitude_rad
        - true
    )
    assert np.std(left, axis=0).max() < 0.6 * 0.005
    jumps = np.flatnonzero(np.diff(since_s) < 0)
    for beside in (jumps, jumps + 1):
        assert np.abs(left[beside].mean(axis=0)).max() < 0.005


def test_attitude_smoother_attenuates_noise_as_a_two_sample_gaussian() -> None:
    """A mean under weights w of independent values has the variance sum w^2 / (sum w)^2."""
    noise = np.random.default_rng(2).normal(0, 0.01, (5000, 2))
    here = replace(
        build_flight([], np.zeros((0, 2))), attitude_s=np.arange(5e3), attitude_rad=noise
    )
    bell = 1 / np.sqrt(2 * np.sqrt(np.pi) * 2.0)
    assert here.smooth_attitude().attitude_rad.std() == pytest.approx(0.01 * bell, rel=0.06)


def test_attitude_of_two_samples_is_unchanged() -> None:
    two = np.array([[0.1, 0.2], [0.3, 0.4]])
    here = replace(build_flight([], np.zeros((0, 2))), attitude_s=np.arange(2.0), attitude_rad=two)
    assert here.smooth_attitude().attitude_rad.tolist() == two.tolist()


@pytest.mark.parametrize("found", [1, 2, 4])
def test_image_without_near_detection_costs_the_maximum(found: int) -> None:
    views, values = (
        [(build_flight(list(range(found)), compute_true_pixels()[:found]), PATH)],
        np.zeros(4),
    )
    misfit = _mean_misfit(views, CAMERA, np.array([*CAMERA.mount_rad, CAMERA.delay_s]), Noise())
    assert misfit == pytest.approx(MAX_SQUARED_RESIDUAL * (4 - found) / 4, abs=1e-6)
    assert 0 < _mean_misfit(views, CAMERA, values, Noise()) <= MAX_SQUARED_RESIDUAL
