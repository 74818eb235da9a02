from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.stats import chi2

from dmrl.estimation.tracking.identity import TrackIdentity
from dmrl.estimation.tracking.tracker import Tracker
from dmrl.estimation.tracking.tracker_input import EgoMotion, ImageDetections
from dmrl.estimation.tracking.tuning import Tuning
from dmrl.geometry.frames import (
    AIDECK,
    Array,
    horizontal_from_pixels,
    is_inside,
    pixels_from_horizontal,
)

TUNING = Tuning()
DT_S = 0.1
LEVEL = np.zeros(1)


@dataclass(frozen=True)
class Detector:
    """What a network makes of peers in view: noise as the tuning says, misses, false alarms."""

    rng: np.random.Generator
    share: float = TUNING.detection_share
    false_per_image: float = TUNING.false_per_image

    def view(self, peers: Array, bias: Array) -> ImageDetections:
        uv, depth_m, _ = pixels_from_horizontal(
            peers, np.zeros(len(peers)), np.zeros(len(peers)), AIDECK
        )
        seen = is_inside(uv, 320, 224) & (depth_m > 0) & (self.rng.random(len(peers)) < self.share)
        noise = self.rng.normal(size=(len(peers), 3))
        tilt_px = TUNING.attitude_std_rad * AIDECK.fx_px * self.rng.normal(size=2)
        uv = uv + TUNING.pixel_std_px * noise[:, :2] + tilt_px
        depth_m = depth_m * np.exp(TUNING.depth_std_ratio * noise[:, 2] + bias)
        alarms = self.rng.poisson(self.false_per_image)
        false_uv = self.rng.uniform((0, 0), (320, 224), (alarms, 2))
        false_m = 0.3 * np.exp(self.rng.uniform(0, np.log(20), alarms))
        return ImageDetections(
            np.concatenate([uv[seen], false_uv]),
            np.concatenate([depth_m[seen], false_m]),
            0.0,
            0.0,
        )


def wandering(rng: np.random.Generator, steps: int, start: Array) -> Iterator[Array]:
    """Positions of a peer that flies about its start, metres."""
    place, speed = start.copy(), np.zeros(3)
    for _ in range(steps):
        speed += 0.8 * np.sqrt(DT_S) * rng.normal(size=3) - DT_S * (0.8 * speed + (place - start))
        place = place + DT_S * speed
        yield place


def depth_biases(rng: np.random.Generator, steps: int, peers: int) -> Iterator[Array]:
    keep = np.exp(-DT_S / TUNING.depth_bias_s)
    bias = rng.normal(size=peers)
    for _ in range(steps):
        yield TUNING.depth_bias_ratio * bias
        bias = keep * bias + np.sqrt(1 - keep**2) * rng.normal(size=peers)


@dataclass
class Outcome:
    """One run: squared errors of tracks and of single detections, and who was followed."""

    squared: list[float]
    track_m2: list[float]
    single_m2: list[float]
    ids: list[int]
    false_tracks: int


def followed(seed: int, starts: Array, steps: int = 600) -> Outcome:
    rng = np.random.default_rng(seed)
    tracker, detector = Tracker(AIDECK, TUNING), Detector(rng)
    paths = [wandering(rng, steps, start) for start in starts]
    out = Outcome([], [], [], [], 0)
    false: set[int] = set()
    for biases in depth_biases(rng, steps, len(starts)):
        truth = np.array([next(path) for path in paths])
        view = detector.view(truth, biases)
        tracks = tracker.step(EgoMotion(DT_S, np.zeros(3), 0.0), view)
        level = np.zeros(len(view.uv))
        single = horizontal_from_pixels(view.uv, view.depth_m, level, level, AIDECK)
        for track in tracks:
            apart = np.linalg.norm(track.position_m - truth, axis=1)
            if apart.min() > 1.0:
                false.add(track.number)
                continue
            error = track.position_m - truth[apart.argmin()]
            out.squared.append(error @ np.linalg.inv(track.covariance) @ error)
            nearest = np.linalg.norm(single - truth[apart.argmin()], axis=1).min(initial=np.inf)
            if nearest < 1.0:
                out.track_m2.append(float(error @ error))
                out.single_m2.append(float(nearest**2))
            out.ids.append(track.number)
    out.false_tracks = len(false)
    return out


def test_a_peer_is_followed_through_misses_and_false_alarms() -> None:
    run = followed(1, np.array([[1.5, 0.0, 0.0]]), steps=150)
    assert len(run.ids) > 100
    longest = max(run.ids.count(number) for number in set(run.ids))
    assert longest > 0.4 * len(run.ids)
    assert np.sqrt(np.mean(run.track_m2)) < 0.4


def test_the_filter_knows_its_error_while_its_model_holds() -> None:
    """No false alarms, no misses: what is left is the filter's own arithmetic."""
    squared: list[float] = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        tracker, detector = Tracker(AIDECK, TUNING), Detector(rng, 1.0, 0.0)
        path = wandering(rng, 60, np.array([1.5, 0.0, 0.0]))
        for truth, bias in zip(path, depth_biases(rng, 60, 1), strict=True):
            for track in tracker.step(STILL, detector.view(truth[None], bias)):
                error = track.position_m - truth
                squared.append(error @ np.linalg.inv(track.covariance) @ error)
    assert 0.88 <= np.mean(np.array(squared) <= chi2.ppf(0.95, 3)) <= 0.99


def test_depths_count_by_what_the_detections_say_of_them() -> None:
    """Every other depth is off by 40 %, the rest by 3 %: one tracker is told which."""
    told, untold, squared = [], [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        trackers = Tracker(AIDECK, TUNING), Tracker(AIDECK, TUNING)
        for step, truth in enumerate(wandering(rng, 80, np.array([1.5, 0.0, 0.0]))):
            seen = view_of(truth[None])
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


def view_of(xyz: Array, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> ImageDetections:
    angles = np.full(len(xyz), roll_rad), np.full(len(xyz), pitch_rad)
    uv, depth_m, _ = pixels_from_horizontal(xyz, *angles, AIDECK)
    return ImageDetections(uv, depth_m, roll_rad, pitch_rad)


NOTHING = ImageDetections(np.zeros((0, 2)), np.zeros(0), 0.0, 0.0)
STILL = EgoMotion(DT_S, np.zeros(3), 0.0)


def test_a_standing_peer_has_no_velocity_whatever_the_observer_does() -> None:
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
        tracks = tracker.step(EgoMotion(DT_S, step, turn), view_of(here, 0.1, -0.05))
    (track,) = tracks
    assert np.allclose(track.position_m, here[0], atol=0.02)
    assert np.abs(track.velocity_mps).max() < 0.05


def test_a_peer_that_is_gone_is_given_up_and_one_out_of_view_is_not_at_once() -> None:
    tracker = Tracker(AIDECK, TUNING)
    for _ in range(10):
        tracker.step(STILL, view_of(np.array([[1.5, 0.0, 0.0]])))
    assert len(tracker.step(STILL, NOTHING)) == 1
    turned = EgoMotion(DT_S, np.zeros(3), 1.5)  # the peer is now beside the image
    assert len(tracker.step(turned, NOTHING)) == 1
    assert all(len(tracker.step(STILL, NOTHING)) == 1 for _ in range(3))
    for _ in range(100):
        left = tracker.step(STILL, NOTHING)
    assert not left


def test_single_false_alarms_never_become_tracks() -> None:
    tracker, rng = Tracker(AIDECK, TUNING), np.random.default_rng(0)
    for _ in range(100):
        xyz = np.array([[rng.uniform(0.5, 3.0), 0.0, 0.0]]) * [1.0, 1.0, 1.0]
        xyz[0, 1:] = xyz[0, 0] * rng.uniform(-0.4, 0.4, 2)
        view = view_of(xyz) if rng.random() < 0.3 else NOTHING
        assert not tracker.step(STILL, view)


def test_two_peers_keep_their_numbers_and_get_their_names_by_range() -> None:
    tracker, identity = Tracker(AIDECK, TUNING), TrackIdentity()
    peers = np.array([[1.0, 0.3, 0.0], [2.2, -0.4, 0.1]])
    distances = dict(zip(("cf2", "cf3"), np.linalg.norm(peers, axis=1).tolist(), strict=True))
    numbers = set()
    for _ in range(40):
        tracks = tracker.step(STILL, view_of(peers))
        names = identity.assign(tracks, distances, DT_S)
        numbers |= {track.number for track in tracks}
    assert len(numbers) == 2
    for track in tracks:
        nearest = np.linalg.norm(peers - track.position_m, axis=1).argmin()
        assert names[track.number] == ("cf2", "cf3")[nearest]


def test_a_track_that_no_range_fits_has_no_name() -> None:
    tracker, identity = Tracker(AIDECK, TUNING), TrackIdentity()
    for _ in range(40):
        tracks = tracker.step(STILL, view_of(np.array([[1.0, 0.0, 0.0]])))
        names = identity.assign(tracks, {"cf2": 4.0, "cf3": 5.0}, DT_S)
    assert tracks
    assert not names


def test_an_image_without_detections_and_one_behind_the_lens_s_fold_are_taken() -> None:
    tracker = Tracker(AIDECK, TUNING)
    assert tracker.step(STILL, NOTHING) == []
    far_out = ImageDetections(np.array([[5000.0, 5000.0]]), np.ones(1), 0.0, 0.0)
    assert tracker.step(STILL, far_out) == []


def test_what_is_not_seen_grows_as_unsure_as_the_tuning_says() -> None:
    tracker = Tracker(AIDECK, TUNING)
    xyz = np.array([[1.5, 0.2, -0.1]])
    uv, depth_m, _ = pixels_from_horizontal(xyz, LEVEL, LEVEL, AIDECK)
    tracker.step(EgoMotion(0.0, np.zeros(3), 0.0), ImageDetections(uv, depth_m, 0.0, 0.0))
    (track,) = tracker.tracks
    assert track.position_m == pytest.approx(xyz[0], abs=1e-6)
    before, dt_s = track.filter.P.copy(), 0.2
    tracker._predict(track, EgoMotion(dt_s, np.zeros(3), 0.0))
    after = track.filter.P
    power = TUNING.acceleration_std_mps2**2
    moved = before[:3, :3] + dt_s**2 * before[3:6, 3:6]
    grown = np.diag(after)[:3] - np.diag(moved)
    own = (TUNING.own_velocity_std_mps * dt_s) ** 2
    turn = (TUNING.yaw_rate_std_radps * dt_s) ** 2
    x, y, _ = track.position_m
    still = power * dt_s**3 / 3
    assert grown == pytest.approx([still + own + turn * y**2, still + own + turn * x**2, still])
    assert after[0, 1] - moved[0, 1] == pytest.approx(-turn * x * y)
    assert np.diag(after)[3:6] - np.diag(before)[3:6] == pytest.approx([power * dt_s] * 3)
    gained = np.diag(after[:3, 3:6] - before[:3, 3:6]) - dt_s * np.diag(before)[3:6]
    assert gained == pytest.approx([power * dt_s**2 / 2] * 3)
    keep = np.exp(-dt_s / TUNING.depth_bias_s)
    assert after[6, 6] == pytest.approx(TUNING.depth_bias_ratio**2)  # as much lost as gained
    assert after[0, 6] == pytest.approx(keep * before[0, 6])


def test_a_track_moves_against_the_observer() -> None:
    tracker = Tracker(AIDECK, TUNING)
    uv, depth_m, _ = pixels_from_horizontal(np.array([[2.0, 0.3, 0.1]]), LEVEL, LEVEL, AIDECK)
    tracker.step(EgoMotion(0.0, np.zeros(3), 0.0), ImageDetections(uv, depth_m, 0.0, 0.0))
    (track,) = tracker.tracks
    track.filter.x[3:6] = 0.5, 0.0, -0.2  # over ground, along the axes before the turn
    tracker._predict(track, EgoMotion(0.5, np.array([0.4, 0.1, 0.05]), np.pi / 2))
    # Ahead by 2 + 0.25 - 0.4 and left by 0.3 - 0.1; after a quarter turn left that is right.
    assert track.position_m == pytest.approx([0.2, -1.85, -0.05])
    assert track.velocity_mps == pytest.approx([0.0, -0.5, -0.2])


def test_a_depth_s_own_deviation_counts_by_its_share_of_the_depth() -> None:
    view = ImageDetections(
        np.zeros((3, 2)), np.array([2.0, 4.0, 1.0]), 0.0, 0.0, np.array([0.3, 0.3, 0.0])
    )
    noise = Tracker(AIDECK, TUNING)._depth_noise(view)
    assert np.sqrt(noise[:, 2, 2]) == pytest.approx([0.15, 0.075, TUNING.depth_std_ratio])
    assert noise[:, :2].max() == noise[:, 2, :2].max() == 0.0


def test_a_new_track_is_as_unsure_as_detections_that_are_drawn() -> None:
    tracker, rng, count = Tracker(AIDECK, replace(TUNING, pixel_std_px=2.0)), default_rng(0), 4_000
    true, tilt = np.array([[1.6, 0.3, -0.2]]), np.array([0.1, -0.05])
    uv, depth_m, _ = pixels_from_horizontal(true, tilt[:1], tilt[1:], AIDECK)
    tracker.step(STILL, ImageDetections(uv, depth_m, *tilt.tolist()))
    (track,) = tracker.tracks
    bias = rng.normal(0, TUNING.depth_bias_ratio, count)
    white = rng.normal(0, TUNING.depth_std_ratio, count)
    pixels = uv + rng.normal(0, 2.0, (count, 2))
    roll, pitch = (tilt[:, None] + rng.normal(0, TUNING.attitude_std_rad, (2, count))).tolist()
    drawn = horizontal_from_pixels(
        pixels, depth_m * (1 - bias - white), np.array(roll), np.array(pitch), AIDECK
    )
    seen = np.cov(np.column_stack([drawn, bias]).T)
    told = track.filter.P[np.ix_([0, 1, 2, 6], [0, 1, 2, 6])]
    assert told == pytest.approx(seen, rel=0.15, abs=1e-3)
    assert np.diag(track.filter.P)[3:6] == pytest.approx(TUNING.speed_std_mps**2)


def test_the_gate_lets_its_share_of_a_peer_s_own_detections_through() -> None:
    tracker, rng = Tracker(AIDECK, replace(TUNING, gate=0.9)), default_rng(1)
    spread = np.array([[16.0, 3.0, 0.1], [3.0, 9.0, 0.0], [0.1, 0.0, 0.02]])
    off = rng.multivariate_normal(np.zeros(3), spread, 5000)
    gain = tracker._log_likelihood_ratios(off, np.tile(spread, (5000, 1, 1)))
    assert np.isfinite(gain).mean() == pytest.approx(0.9, abs=0.015)
    # At its middle: how much likelier a detection is from a track than a false alarm.
    best = tracker._log_likelihood_ratios(np.zeros((1, 3)), spread[None])
    alarms = TUNING.false_per_image / (AIDECK.width_px * AIDECK.height_px * np.log(20))
    wanted = TUNING.detection_share / alarms / np.sqrt(np.linalg.det(2 * np.pi * spread))
    assert best == pytest.approx(np.log(wanted))
