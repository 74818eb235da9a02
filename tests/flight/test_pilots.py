"""Pilots without a simulation: what they command for what they are told."""

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.flight.leader_belief import LeaderBelief
from dmrl.flight.pilot import Command, Observation, PeerTrack, Pilot, Task
from dmrl.flight.pilots import PILOTS, Follow, KeepApart, find_pilot

TASK = Task("cf1", leader="cf2", distance_m=0.7)


def track(
    x: float, y: float, std_m: float = 0.05, peer: str = "cf2", age_s: float = 0.1, vy: float = 0.0
) -> PeerTrack:
    velocity = np.array([0.0, vy, 0.0])
    return PeerTrack(1, peer, np.array([x, y, 0.0]), velocity, std_m**2 * np.eye(3), age_s)


def observe(time_s: float, *tracks: PeerTrack, image_age_s: float = 0.1) -> Observation:
    rest = 0.0, 0.0, 0.0, np.zeros(2), 1.0
    return Observation(time_s, *rest, tracks=tracks, image_age_s=image_age_s)


def test_it_flies_to_a_far_leader_from_a_near_one_and_turns_to_it() -> None:
    far = Follow(TASK).command(observe(0.0, track(1.5, 0.5)))
    near = Follow(TASK).command(observe(0.0, track(0.5, 0.0)))
    assert far.vx_mps > 0.3 and far.vy_mps > 0.1 and far.yaw_rate_radps > 0.5
    assert near.vx_mps < -0.1 and near.yaw_rate_radps == pytest.approx(0.0)


def test_it_flies_slower_to_a_leader_whose_place_is_uncertain() -> None:
    speeds = [
        Follow(TASK).command(observe(0.0, track(1.5, 0.0, std_m))).vx_mps
        for std_m in (0.05, 0.3, 0.6, 1.2)
    ]
    assert speeds == sorted(speeds, reverse=True)
    assert speeds[0] > 0.9 and speeds[-1] < 0.1


def test_it_slows_and_turns_to_where_the_leader_was_heading() -> None:
    for side in (1.0, -1.0):
        pilot = Follow(TASK)
        pilot.command(observe(0.0, track(1.0, 0.0, vy=0.6 * side)))
        commands = [pilot.command(observe(k / 20, image_age_s=0.1)) for k in range(1, 60)]
        assert all(np.hypot(c.vx_mps, c.vy_mps) < 1.0 for c in commands)
        assert np.hypot(commands[-1].vx_mps, commands[-1].vy_mps) < 0.35
        assert sum(c.yaw_rate_radps for c in commands[:30]) * side > 0


def test_it_backs_away_from_a_leader_that_it_does_not_see() -> None:
    pilot = Follow(TASK)
    pilot.command(observe(0.0, track(0.75, 0.0)))
    after = [pilot.command(observe(k / 20)) for k in range(1, 40)]
    assert after[-1].vx_mps < 0.1


def test_another_robots_track_is_not_followed() -> None:
    pilot = Follow(TASK)
    command = pilot.command(observe(0.0, track(1.0, 0.8, peer="cf3"), track(1.5, -0.8)))
    assert command.yaw_rate_radps < 0
    only = Follow(TASK).command(observe(0.0, track(2.5, 2.0, peer="cf3")))
    assert abs(only.yaw_rate_radps) < 0.7


def test_every_pilot_moves_away_from_a_peer_that_is_too_near() -> None:
    for form in PILOTS.values():
        command = form(TASK).command(observe(0.0, track(0.3, 0.0, peer="cf3"), track(0.7, 0.0)))
        assert command.vx_mps < 0
    assert KeepApart(TASK).command(observe(0.0, track(1.0, 0.0))) == Command()


def test_images_without_a_detection_move_the_belief_out_of_view() -> None:
    belief = LeaderBelief(np.array([0.8, 0.3]), np.zeros(2), 0.3**2 * np.eye(2))
    still = observe(0.0)
    for _ in range(30):
        belief.move(still, 0.1)
        belief.miss()
    away = np.abs(belief.bearing_rad)
    assert belief.weight[away > 0.6].sum() > 0.8
    assert abs(belief.best_bearing()) > 0.6


def test_pilots_are_found_by_name() -> None:
    assert find_pilot("follow") is Follow
    with pytest.raises(SettingError, match=r"no pilot nobody. Choose one of: .*keep_apart"):
        find_pilot("nobody")
    with pytest.raises(TypeError):
        Pilot(TASK)  # type: ignore[abstract]
