"""Tracks of peers from detections, compared with simulations of the tracker's own model."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.stats import chi2

from dmrl.estimation.tracking.association import associate
from dmrl.estimation.tracking.identity import TrackIdentity
from dmrl.estimation.tracking.track_states import SILENT, TrackStates
from dmrl.estimation.tracking.tracker import Tracker
from dmrl.estimation.tracking.tracker_input import EgoMotion, ImageDetections
from dmrl.geometry.frames import (
    AIDECK,
    Array,
    horizontal_from_pixels,
    pixels_from_horizontal,
)

from .drawn_peers import (
    CALIBRATED,
    DT_S,
    TUNING,
    Detector,
    run_tracker,
    simulate_depth_biases,
    simulate_path,
)


@pytest.mark.heavy
def test_a_peer_is_followed_through_misses_and_false_alarms() -> None:
    run = run_tracker(1, np.array([[1.5, 0.0, 0.0]]), steps=150)
    assert len(run.ids) > 100
    assert max(run.ids.count(number) for number in set(run.ids)) > 0.4 * len(run.ids)
    assert np.sqrt(np.mean(run.track_m2)) < 0.4


@pytest.mark.heavy
def test_tracker_covariance_is_consistent_under_its_model() -> None:
    """There are no false alarms and no misses, so only the filter itself is tested."""
    squared: list[float] = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        tracker, detector = Tracker(AIDECK, TUNING, CALIBRATED), Detector(rng, 1.0, 0.0)
        path = simulate_path(rng, 60, np.array([1.5, 0.0, 0.0]))
        for truth, bias in zip(path, simulate_depth_biases(rng, 60, 1), strict=True):
            for track in tracker.step(STILL, detector.view(truth[None], bias)):
                error = track.position_m - truth
                squared.append(error @ np.linalg.inv(track.covariance) @ error)
    assert 0.88 <= np.mean(np.array(squared) <= chi2.ppf(0.95, 3)) <= 0.99


@pytest.mark.heavy
def test_tracker_weights_depths_by_their_sigma() -> None:
    """Depths alternate between 40 % and 3 % noise, and only one tracker gets the sigmas."""
    told, untold, squared = [], [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        trackers = Tracker(AIDECK, TUNING), Tracker(AIDECK, TUNING)
        for step, truth in enumerate(simulate_path(rng, 80, np.array([1.5, 0.0, 0.0]))):
            seen = project_peers(truth[None])
            uv = seen.uv + TUNING.pixel_std_px * rng.normal(size=2)
            ratio = (0.03, 0.4)[step % 2]
            depth_m = seen.depth_m * np.exp(ratio * rng.normal(size=1))
            plain = replace(seen, uv=uv, depth_m=depth_m)
            views = replace(plain, sigma_depth_m=ratio * depth_m), plain
            for tracker, view, errors in zip(trackers, views, (told, untold), strict=True):
                for track in tracker.step(STILL, view):
                    error = track.position_m - truth
                    errors.append(float(error @ error))
                    if tracker is trackers[0]:
                        squared.append(error @ np.linalg.inv(track.covariance) @ error)
    assert np.sqrt(np.mean(told)) < 0.7 * np.sqrt(np.mean(untold))
    assert np.mean(np.array(squared) <= chi2.ppf(0.95, 3)) >= 0.88


def project_peers(
    xyz: Array, roll_rad: float = 0.0, pitch_rad: float = 0.0, confidence: float = 0.9
) -> ImageDetections:
    """Return exact detections of peers at (K, 3) positions, horizontal frame, metres."""
    angles = np.full(len(xyz), roll_rad), np.full(len(xyz), pitch_rad)
    uv, depth_m, _ = pixels_from_horizontal(xyz, *angles, AIDECK)
    return ImageDetections(uv, depth_m, roll_rad, pitch_rad, np.full(len(xyz), confidence))


NOTHING = ImageDetections(np.zeros((0, 2)), np.zeros(0), 0.0, 0.0, np.zeros(0))
STILL = EgoMotion(DT_S, np.zeros(3), 0.0)


@pytest.mark.heavy
def test_static_peer_has_zero_velocity_for_a_moving_observer() -> None:
    tracker = Tracker(AIDECK, TUNING)
    peer, own, yaw = np.array([1.8, 0.0, 0.1]), np.zeros(3), 0.0
    for k in range(60):
        step, turn = np.array([0.01, 0.02 * np.sin(k / 5), 0.005]), 0.02 * np.cos(k / 7)
        c, s = np.cos(yaw), np.sin(yaw)
        own = own + np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])
        yaw += turn
        c, s = np.cos(yaw), np.sin(yaw)
        x, y, z = peer - own
        here = np.array([[c * x + s * y, -s * x + c * y, z]])
        tracks = tracker.step(EgoMotion(DT_S, step, turn), project_peers(here, 0.1, -0.05))
    (track,) = tracks
    assert np.allclose(track.position_m, here[0], atol=0.02)
    assert np.abs(track.velocity_mps).max() < 0.05


@pytest.mark.heavy
def test_track_of_peer_out_of_view_outlives_a_missing_one() -> None:
    tracker = Tracker(AIDECK, TUNING)
    for _ in range(10):
        tracker.step(STILL, project_peers(np.array([[1.5, 0.0, 0.0]])))
    assert len(tracker.step(STILL, NOTHING)) == 1
    turned = EgoMotion(DT_S, np.zeros(3), 1.5)  # the peer is then out of view
    assert len(tracker.step(turned, NOTHING)) == 1
    assert all(len(tracker.step(STILL, NOTHING)) == 1 for _ in range(3))
    for _ in range(300):
        left = tracker.step(STILL, NOTHING)
    assert not left


@pytest.mark.heavy
def test_single_false_alarms_never_become_tracks() -> None:
    tracker, rng = Tracker(AIDECK, TUNING), np.random.default_rng(0)
    for _ in range(100):
        xyz = np.array([[rng.uniform(0.5, 3.0), 0.0, 0.0]]) * [1.0, 1.0, 1.0]
        xyz[0, 1:] = xyz[0, 0] * rng.uniform(-0.4, 0.4, 2)
        view = project_peers(xyz, confidence=0.5) if rng.random() < 0.3 else NOTHING
        assert not tracker.step(STILL, view)


@pytest.mark.parametrize(("confidence", "images"), [(0.95, 1), (0.8, 5), (0.1, None)])
@pytest.mark.heavy
def test_confidence_decides_when_a_lasting_detection_is_a_peer(
    confidence: float, images: int | None
) -> None:
    tracker, view = Tracker(AIDECK, TUNING), project_peers(np.array([[1.2, 0.1, 0.0]]))
    view = replace(view, confidence=np.array([confidence]))
    seen = [bool(tracker.step(STILL, view)) for _ in range(60)]
    if images is None:
        assert not any(seen)
    else:
        assert True in seen[1 : images + 3]
        assert not seen[0]


@pytest.mark.parametrize(
    ("share_of_memory", "confidences", "told"),
    [
        (1e-6, (0.8, 0.8), 0.0),  # an equal confidence adds nothing
        (1e-6, (0.8, 0.95), 0.5),  # half of the change counts
        (50.0, (0.8, 0.95), 1.0),  # much later the full confidence counts
    ],
)
def test_only_the_change_of_a_confidence_counts(
    monkeypatch: pytest.MonkeyPatch,
    share_of_memory: float,
    confidences: tuple[float, float],
    told: float,
) -> None:
    peer = np.array([[1.2, 0.1, 0.0]])
    tracker, spy = Tracker(AIDECK, TUNING), Mock(side_effect=associate)
    monkeypatch.setattr("dmrl.estimation.tracking.tracker.associate", spy)
    first, second = confidences
    tracker.step(STILL, project_peers(peer, confidence=first))
    later = replace(STILL, dt_s=share_of_memory * TUNING.confidence_s)
    tracker.step(later, project_peers(peer, confidence=second))
    before, now = tracker.rates.log_ratio(np.array(confidences))
    bright = spy.call_args.args[3]
    assert np.log(bright) == pytest.approx(told * (now - (told < 1) * before), abs=1e-4)


@pytest.mark.heavy
def test_weak_detections_keep_an_expected_track_accurate() -> None:
    """One of two equal tracks gets weak detections, the other none."""
    weak, blind = Tracker(AIDECK, TUNING), Tracker(AIDECK, TUNING)
    peer = np.array([[1.2, 0.1, 0.0]])
    for _ in range(20):
        weak.step(STILL, project_peers(peer))
        blind.step(STILL, project_peers(peer))
    for _ in range(15):
        (held,) = weak.step(STILL, project_peers(peer, confidence=0.1))
        (coasts,) = blind.step(STILL, NOTHING)
    assert held.unseen_s == 0.0
    assert coasts.unseen_s == pytest.approx(1.5)
    assert np.trace(held.covariance) < 0.25 * np.trace(coasts.covariance)
    assert held.existence > 0.9


@pytest.mark.heavy
def test_missed_detections_lower_existence_more_at_short_distance() -> None:
    fallen = []
    for distance_m in (0.75, 1.75):
        tracker = Tracker(AIDECK, TUNING)
        for _ in range(20):
            tracker.step(STILL, project_peers(np.array([[distance_m, 0.0, 0.0]])))
        before = float(tracker.states.existence[0])
        for _ in range(10):
            (track,) = tracker.step(STILL, NOTHING)
        fallen.append(before - track.existence)
    assert 0 < fallen[1] < fallen[0] < 0.4


@pytest.mark.heavy
def test_two_tracks_keep_numbers_and_are_named_by_range() -> None:
    tracker, identity = Tracker(AIDECK, TUNING), TrackIdentity()
    peers = np.array([[1.0, 0.3, 0.0], [2.2, -0.4, 0.1]])
    distances = dict(zip(("cf2", "cf3"), np.linalg.norm(peers, axis=1).tolist(), strict=True))
    numbers = set()
    for _ in range(40):
        tracks = tracker.step(STILL, project_peers(peers))
        names = identity.assign(tracks, distances, DT_S)
        numbers |= {track.number for track in tracks}
    assert len(numbers) == 2
    for track in tracks:
        nearest = np.linalg.norm(peers - track.position_m, axis=1).argmin()
        assert names[track.number] == ("cf2", "cf3")[nearest]


def test_track_without_matching_range_has_no_name() -> None:
    tracker, identity = Tracker(AIDECK, TUNING), TrackIdentity()
    for _ in range(40):
        tracks = tracker.step(STILL, project_peers(np.array([[1.0, 0.0, 0.0]])))
        names = identity.assign(tracks, {"cf2": 4.0, "cf3": 5.0}, DT_S)
    assert tracks
    assert not names


def test_tracker_accepts_empty_images_and_pixels_beyond_the_lens_model() -> None:
    tracker = Tracker(AIDECK, TUNING)
    assert tracker.step(STILL, NOTHING) == []
    far_out = ImageDetections(np.array([[5000.0, 5000.0]]), np.ones(1), 0.0, 0.0, np.ones(1))
    assert tracker.step(STILL, far_out) == []


def start_track(xyz: Array) -> TrackStates:
    """Return the states after a first image of one peer."""
    tracker = Tracker(AIDECK, TUNING)
    tracker.step(EgoMotion(0.0, np.zeros(3), 0.0), project_peers(xyz))
    return tracker.states


@pytest.mark.heavy
def test_predicted_covariance_matches_simulated_motion_model() -> None:
    """Samples have the Gauss-Markov velocity, position drift and heading drift of the tuning."""
    rng, count, dt_s, steps = default_rng(2), 20_000, 0.1, 12
    states = start_track(np.array([[1.5, 0.2, -0.1]]))
    (mean,), (covariance,) = states.cartesian()
    drawn = rng.multivariate_normal(mean, covariance, count)
    t = TUNING
    std, calm = np.array([t.speed_std_mps] * 2 + [t.climb_std_mps]), np.exp(-0.01 / t.velocity_s)
    for _ in range(steps):
        states.predict(EgoMotion(dt_s, np.zeros(3), 0.0), t)
        for _ in range(10):
            drawn[:, :3] += 0.01 * drawn[:, 3:]
            drawn[:, 3:] *= calm
            drawn[:, 3:] += np.sqrt(1 - calm**2) * std * rng.normal(size=(count, 3))
        drawn[:, :2] += t.own_drift_m * np.sqrt(dt_s) * rng.normal(size=(count, 2))
        drawn[:, 2] += t.own_height_std_m * rng.normal(size=count)
        turn = t.yaw_drift_rad * np.sqrt(dt_s) * rng.normal(size=count)
        drawn[:, :2] += turn[:, None] * drawn[:, [1, 0]] * [1.0, -1.0]
    (mean,), (covariance,) = states.cartesian()
    assert mean == pytest.approx(drawn.mean(axis=0), abs=0.03)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(drawn.std(axis=0), rel=0.08)


def test_prediction_subtracts_the_observer_motion() -> None:
    states = start_track(np.array([[2.0, 0.3, 0.1]]))
    states.mean[0, 3:6] = 0.5, 0.0, -0.2  # velocity over ground, in axes before the turn
    states.predict(EgoMotion(0.5, np.array([0.4, 0.1, 0.05]), np.pi / 2), TUNING)
    calm = np.exp(-0.5 / TUNING.velocity_s)
    reach_s = TUNING.velocity_s * (1 - calm)
    # Before the turn: x = 2 + 0.5 reach - 0.4, y = 0.3 - 0.1. After 90 degrees left: (y, -x).
    place = [0.2, -1.6 - 0.5 * reach_s, 0.05 - 0.2 * reach_s]
    (mean,), _ = states.cartesian()
    assert mean == pytest.approx([*place, 0.0, -0.5 * calm, -0.2 * calm])


def test_depth_noise_is_sigma_relative_to_depth() -> None:
    view = replace(
        project_peers(np.ones((3, 3))),
        depth_m=np.array([2.0, 4.0, 1.0]),
        sigma_depth_m=np.array([0.3, 0.3, 0.0]),
    )
    noise = Tracker(AIDECK, TUNING)._depth_noise(view)
    assert np.sqrt(noise[:, 2, 2]) == pytest.approx([0.15, 0.075, TUNING.depth_std_ratio])
    assert noise[:, :2].max() == noise[:, 2, :2].max() == 0.0


def test_covariance_of_a_new_track_matches_sampled_detections() -> None:
    tracker, rng, count = Tracker(AIDECK, replace(TUNING, pixel_std_px=2.0)), default_rng(0), 4_000
    true, tilt = np.array([[1.6, 0.3, -0.2]]), np.array([0.1, -0.05])
    uv, depth_m, _ = pixels_from_horizontal(true, tilt[:1], tilt[1:], AIDECK)
    tracker.step(STILL, ImageDetections(uv, depth_m, *tilt.tolist(), np.array([0.9])))
    bias = rng.normal(0, TUNING.depth_bias_ratio, count)
    white = rng.normal(0, TUNING.depth_std_ratio, count)
    pixels = uv + rng.normal(0, 2.0, (count, 2))
    roll, pitch = (tilt[:, None] + rng.normal(0, TUNING.tilt_std_rad, (2, count))).tolist()
    drawn = horizontal_from_pixels(
        pixels, depth_m * np.exp(-bias - white), np.array(roll), np.array(pitch), AIDECK
    )
    range_m = np.linalg.norm(drawn, axis=1)
    polar = np.arctan2(drawn[:, 1], drawn[:, 0]), np.arcsin(drawn[:, 2] / range_m), np.log(range_m)
    seen = np.cov(np.column_stack([*polar, bias]).T)
    told = tracker.states.covariance[0][np.ix_([0, 1, 2, 6], [0, 1, 2, 6])]
    assert told == pytest.approx(seen, rel=0.15, abs=1e-4)
    std = [TUNING.speed_std_mps] * 2 + [TUNING.climb_std_mps]
    assert np.sqrt(np.diag(tracker.states.covariance[0])[3:6]) == pytest.approx(std)


@pytest.mark.heavy
def test_constant_tilt_bias_stays_in_the_covariance() -> None:
    tracker, xyz = Tracker(AIDECK, TUNING), np.array([[1.5, 0.0, 0.0]])
    tracker.step(STILL, project_peers(xyz))
    for _ in range(200):
        (track,) = tracker.step(STILL, project_peers(xyz))
    plain = np.sqrt(tracker.states.cartesian()[1][0, 2, 2])
    silent = tracker.states.belief[0, SILENT] / track.existence
    captured = TUNING.capture_std_m * np.sqrt(silent)
    wanted = np.linalg.norm([plain, TUNING.tilt_bias_rad * 1.5, captured])
    assert np.sqrt(track.covariance[2, 2]) == pytest.approx(wanted, rel=1e-3)
    assert silent < 0.01


def test_shared_detection_is_weighted_between_tracks() -> None:
    """Two certain tracks share a detection with likelihood ratios of 50 and 10."""
    belief = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    found = np.tile([0.0, 0.9, 0.9, 0.03], (2, 1))
    near = np.array([[50.0], [10.0]])
    weights = associate(belief, found, near, np.ones((2, 1)))
    share = [0.9 * 50 / (0.1 + 0.9 * 50), 0.9 * 10 / (0.1 + 0.9 * 10)]
    rival = 50 * share[0] / (1 - share[0]), 10 * share[1] / (1 - share[1])
    claim = [0.9 * 50 / (1 + rival[1]), 0.9 * 10 / (1 + rival[0])]
    wanted = [c / (0.1 + c) for c in claim]
    assert weights.detection[:, 0] == pytest.approx(wanted, rel=1e-6)
    assert weights.detection[:, 0] + weights.miss == pytest.approx([1.0, 1.0])
    alone = associate(belief[:1], found[:1], near[:1], np.ones((1, 1)))
    assert alone.detection[0, 0] == pytest.approx(share[0])


def test_confident_detections_update_belief_by_bayes_rule() -> None:
    belief = np.array([[0.5, 0.2, 0.2, 0.1]])
    found = np.array([[0.0, 0.9, 0.9, 0.0]])
    weights = associate(belief, found, np.array([[20.0]]), np.array([[4.0]]))
    after = np.array([0.5, 0.2 * (0.1 + 0.9 * 20), 0.2 * (0.1 + 0.9 * 20 * 4), 0.1])
    assert weights.belief[0] == pytest.approx(after / after.sum())
