"""The mount and delay of a camera, calibrated from detections in simulated flights."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.estimation.calibration import extrinsics
from dmrl.estimation.calibration.extrinsics import (
    MIN_LOG_LIKELIHOOD_GAP,
    PROBE_SIGMAS,
    SAME_DELAY_S,
    SAMPLING_STD_SHARE,
    _check_unambiguous,
    _delay_std_s,
    calibrate_mount,
)
from dmrl.estimation.calibration.mount_solver import MountEstimate
from dmrl.estimation.calibration.noise import Noise
from dmrl.estimation.calibration.observations import CalibrationFlight, PeerPath, match_detections
from dmrl.geometry.frames import AIDECK, Camera, is_inside, pixels_from_horizontal

TRUE = replace(AIDECK, mount_rad=(0.02, 0.035, -0.03), delay_s=0.03)


def simulate_calibration_flight(
    seed: int, camera: Camera = TRUE, images: int = 400, outliers: float = 0.1
) -> CalibrationFlight:
    """Simulate a peer that moves in view, with detections of 3 px noise and some outliers."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0, images / 10 + 2, 0.05)
    phase = rng.uniform(0, 6, 4)
    xyz = np.column_stack(
        [
            1.4 + 0.4 * np.sin(0.7 * time_s + phase[0]),
            0.5 * np.sin(1.3 * time_s + phase[1]),
            -0.15 + 0.2 * np.sin(0.9 * time_s + phase[2]),
        ]
    )
    attitude = 0.08 * np.column_stack([np.sin(2.1 * time_s + phase[3]), np.cos(1.7 * time_s)])
    image_s = 1.0 + np.arange(images) / 10
    at_s = image_s - camera.delay_s
    there = np.column_stack([np.interp(at_s, time_s, axis) for axis in xyz.T])
    roll, pitch = (np.interp(at_s, time_s, angle) for angle in attitude.T)
    uv, _, _ = pixels_from_horizontal(there, roll, pitch, camera)
    uv += rng.normal(0, 3.0, uv.shape)
    wild = rng.random(images) < outliers
    uv[wild] = rng.uniform((0, 0), (320, 224), (int(wild.sum()), 2))
    seen = np.flatnonzero(is_inside(uv, 320, 224))
    covariance = np.broadcast_to(0.01**2 * np.eye(3), (len(time_s), 3, 3))
    peers = {"cf2": PeerPath(time_s, xyz, covariance)}
    return CalibrationFlight(image_s, seen, uv[seen], time_s, attitude, peers)


@pytest.mark.heavy
def test_mount_and_delay_are_recovered() -> None:
    found = calibrate_mount(
        [simulate_calibration_flight(0, images=1200)], AIDECK, Noise(3.0, 0.005)
    )
    assert found is not None
    assert np.degrees(found.camera.mount_rad) == pytest.approx(np.degrees(TRUE.mount_rad), abs=0.3)
    assert found.camera.delay_s == pytest.approx(TRUE.delay_s, abs=0.005)
    assert found.after_px < 0.6 * found.before_px
    errors = np.subtract(found.camera.mount_rad, TRUE.mount_rad) / found.mount_std_rad
    assert np.abs(errors).max() < 4.0


@pytest.mark.heavy
def test_exact_mount_and_delay_stay_unchanged() -> None:
    found = calibrate_mount([simulate_calibration_flight(1, AIDECK)], AIDECK, Noise(3.0, 0.005))
    assert found is not None
    assert np.abs(np.degrees(found.camera.mount_rad)).max() < 0.3
    assert abs(found.camera.delay_s) < 0.005


@pytest.mark.heavy
def test_mount_std_of_several_flights_is_cross_validated() -> None:
    found = calibrate_mount(
        [simulate_calibration_flight(seed, images=150) for seed in range(4)],
        AIDECK,
        Noise(3.0, 0.005),
    )
    assert found is not None
    assert np.degrees(found.camera.mount_rad) == pytest.approx(np.degrees(TRUE.mount_rad), abs=0.3)
    assert 0 < max(found.mount_std_rad) < np.radians(0.5)


def test_unmatched_detections_give_no_calibration() -> None:
    assert (
        calibrate_mount([simulate_calibration_flight(2, outliers=1.0, images=60)], AIDECK, Noise())
        is None
    )


@pytest.mark.heavy
def test_gaps_in_the_positions_are_not_bridged() -> None:
    whole = simulate_calibration_flight(3)
    peer = whole.peers["cf2"]
    keep = (peer.time_s < 10) | (peer.time_s > 25)
    holed = PeerPath(peer.time_s[keep], peer.xyz_m[keep], peer.covariance[keep])
    found = calibrate_mount([replace(whole, peers={"cf2": holed})], AIDECK, Noise(3.0, 0.005))
    assert found is not None
    assert found.matched < 300


@pytest.mark.heavy
@pytest.mark.parametrize("delay_s", [-0.3, 0.0, 0.2])
def test_delay_is_independent_of_its_initial_guess(delay_s: float) -> None:
    # The logged attitude has noise that moves the predicted peer by a pixel between samples.
    rng = np.random.default_rng(7)
    clean = simulate_calibration_flight(5, images=400)
    at_s = np.arange(0, clean.attitude_s[-1], 0.01)
    noisy = np.column_stack([np.interp(at_s, clean.attitude_s, a) for a in clean.attitude_rad.T])
    noisy += rng.normal(0, 0.01, noisy.shape)
    seen = replace(clean, attitude_s=at_s, attitude_rad=noisy)
    found = calibrate_mount([seen], replace(AIDECK, delay_s=delay_s), Noise(3.0, 0.01))
    assert found is not None
    assert found.camera.delay_s == pytest.approx(TRUE.delay_s, abs=0.008)


def _simulate_tilts(time_s: np.ndarray) -> np.ndarray:
    """Return (N, 2) roll and pitch that jump every 2.5 s and decay within 0.25 s."""
    rng = np.random.default_rng(3)
    tilt = np.zeros((len(time_s), 2))
    for turned_s in np.arange(0.0, time_s[-1], 2.5):
        since_s = time_s - turned_s
        tilt += rng.normal(0, 0.12, 2) * np.where(since_s >= 0, np.exp(-since_s / 0.25), 0)[:, None]
    return tilt


@pytest.mark.heavy
def test_abrupt_tilts_do_not_bias_the_delay() -> None:
    rng = np.random.default_rng(11)
    clean = simulate_calibration_flight(6, images=600)
    log_s = np.arange(0.0, clean.image_s[-1] + 1, 0.01)
    peer = clean.peers["cf2"]
    taken_s = clean.image_s - TRUE.delay_s
    roll, pitch = (np.interp(taken_s, log_s, angle) for angle in _simulate_tilts(log_s).T)
    uv, _, _ = pixels_from_horizontal(peer.interpolate_at(taken_s), roll, pitch, TRUE)
    seen = np.flatnonzero(is_inside(uv, 320, 224))
    uv = uv[seen] + rng.normal(0, 1.0, (len(seen), 2))
    logged = _simulate_tilts(log_s) + rng.normal(0, 0.005, (len(log_s), 2))
    shown = replace(clean, image=seen, uv=uv, attitude_s=log_s, attitude_rad=logged)
    found = calibrate_mount([shown], AIDECK, Noise(2.0, 0.005))
    assert found is not None
    assert found.camera.delay_s == pytest.approx(TRUE.delay_s, abs=0.003)


@pytest.mark.heavy
def test_temporary_path_errors_do_not_bias_the_mount() -> None:
    # A fixed matching radius of 25 px would keep only half of a path with errors of 30 px.
    clean = simulate_calibration_flight(8, images=900, outliers=0.0)
    peer = clean.peers["cf2"]
    off_m = np.zeros_like(peer.xyz_m)
    off_m[:, 1] = 0.25 * np.sign(np.sin(2 * np.pi * peer.time_s / 25.0) - 0.6)
    wide = np.broadcast_to(np.diag([0.02, 0.25, 0.02]) ** 2, peer.covariance.shape)
    moved = PeerPath(peer.time_s, peer.xyz_m + off_m, wide)
    found = calibrate_mount([replace(clean, peers={"cf2": moved})], AIDECK, Noise(3.0, 0.005))
    assert found is not None
    assert found.matched > 850


@pytest.mark.heavy
def test_detection_noise_is_estimated() -> None:
    sharp, blunt = (
        calibrate_mount(
            [simulate_calibration_flight(9, images=600, outliers=0.0)], AIDECK, Noise(pixels, 0.005)
        )
        for pixels in (3.0, 9.0)
    )
    assert sharp is not None
    assert blunt is not None
    assert blunt.mount_std_rad == pytest.approx(sharp.mount_std_rad, rel=0.05)


def build_mount(values: np.ndarray, std_s: float, cost: float = 5.0) -> MountEstimate:
    """Return an estimate of mount angles and delay with this std of the delay, seconds."""
    covariance = np.diag([1e-4, 1e-4, 1e-4, std_s**2])
    return MountEstimate(values, covariance, cost, 2.0)


@pytest.mark.parametrize(("true_s", "wanted_s"), [(0.003, 0.003), (0.0004, 0.001)])
def test_delay_std_follows_curvature_of_the_cost(
    true_s: float, wanted_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cost is a parabola around the best delay, whose width differs from the solve's std."""
    values = np.array([0.01, 0.02, -0.03, 0.1])
    asked = []

    def solve(views: object, camera: object, matched: object, start: np.ndarray, *rest: object,
              fix_delay: bool) -> MountEstimate:  # fmt: skip
        assert fix_delay and start[:3].tolist() == values[:3].tolist() and rest[1] == 2.0
        asked.append(start[3] - values[3])
        return build_mount(start, 0.001, 5.0 + 0.5 * (asked[-1] / true_s) ** 2)

    monkeypatch.setattr(extrinsics, "solve_mount", solve)
    one = simulate_calibration_flight(0, images=20)
    views = [(one, one.peers["cf2"])]
    matched = match_detections(views, TRUE, 30.0, Noise())
    found = _delay_std_s(views, TRUE, matched, build_mount(values, 0.001), Noise())
    sample_s = float(np.median(np.diff(one.attitude_s)))
    assert found == pytest.approx(np.hypot(wanted_s, SAMPLING_STD_SHARE * sample_s), rel=1e-6)
    assert np.array(asked) == pytest.approx(0.001 * np.array(PROBE_SIGMAS))


def test_two_equally_likely_delays_are_refused() -> None:
    best = build_mount(np.array([0, 0, 0, 0.05]), 0.001)
    for apart_s, worse, refused in (
        (1.01 * SAME_DELAY_S, 0.99 * MIN_LOG_LIKELIHOOD_GAP, True),
        (-1.01 * SAME_DELAY_S, 0.99 * MIN_LOG_LIKELIHOOD_GAP, True),
        (0.99 * SAME_DELAY_S, 0.0, False),
        (1.01 * SAME_DELAY_S, 1.01 * MIN_LOG_LIKELIHOOD_GAP, False),
    ):
        other = build_mount(np.array([0, 0, 0, 0.05 + apart_s]), 0.001, 5.0 + worse)
        if refused:
            with pytest.raises(SettingError, match=r"delays of 50 and .* ms explain"):
                _check_unambiguous([best, other])
        else:
            _check_unambiguous([best, other])


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (replace(AIDECK, mount_rad=(0.44, 0.0, 0.0)), "the roll comes out at 20 degrees"),
        (replace(AIDECK, delay_s=0.6), "the delay comes out at .*500 ms"),
    ],
)
def test_a_mount_or_delay_beyond_the_limits_is_refused(camera: Camera, words: str) -> None:
    with pytest.raises(SettingError, match=words):
        calibrate_mount([simulate_calibration_flight(2, camera)], AIDECK, Noise(3.0, 0.005))
