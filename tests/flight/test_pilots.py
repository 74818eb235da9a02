"""Commands of pilots for given observations, without a simulation."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.flight.pilot import Command, Observation, PeerTrack, Pilot, Task
from dmrl.flight.pilots import PILOTS, Follow, Formation, KeepApart, find_pilot
from dmrl.geometry.frames import AIDECK_PINHOLE

TASK = Task("cf1", leader="cf2", distance_m=0.7)
Places = list[tuple[float, float]]


def build_track(x: float, y: float) -> PeerTrack:
    """Return the track of a peer at rest, in metres ahead and to the left."""
    place = np.array([x, y, 0.0])
    return PeerTrack(1, "cf2", place, np.zeros(3), 0.0025 * np.eye(3), 0.1)


def observe(
    time_s: float, places: Places, confidence: float = 0.95, image_age_s: float = 0.0
) -> Observation:
    """Return the observation of a level robot at rest with peers at its height."""
    camera = AIDECK_PINHOLE
    found = tuple(
        (camera.cx_px - camera.fx_px * y / x, camera.cy_px, x, confidence) for x, y in places
    )
    rest = 0.0, 0.0, 0.0, np.zeros(2), 1.0
    return Observation(time_s, *rest, image_age_s=image_age_s, detections=found)


def fly(pilot: Pilot, places: Places, first: int = 0, steps: int = 10) -> list[Command]:
    """Show a pilot the same peers ten times per second; return its commands."""
    return [pilot.command(observe(0.1 * (first + k), places)) for k in range(steps)]


def test_pilot_keeps_its_distance_and_faces_the_leader() -> None:
    far = fly(Follow(TASK), [(1.1, 0.3)])[-1]
    near = fly(Follow(TASK), [(0.5, 0.0)])[-1]
    assert far.vx_mps > 0.2 and far.vy_mps > 0.05 and far.yaw_rate_radps > 0.5
    assert near.vx_mps < -0.1 and abs(near.yaw_rate_radps) < 0.05


def test_pilot_slows_down_while_detections_are_missing() -> None:
    pilot = Follow(TASK)
    before = fly(pilot, [(1.0, 0.0)])[-1].vx_mps
    speeds = [pilot.command(observe(1.0 + 0.1 * k, [])).vx_mps for k in range(6)]
    assert [before, *speeds] == sorted([before, *speeds], reverse=True)
    assert before - speeds[-1] > 0.1


def test_without_detections_it_stops_and_turns_to_the_side_of_the_leader() -> None:
    for side in (1.0, -1.0):
        pilot = Follow(TASK)
        for k in range(10):
            pilot.command(observe(0.1 * k, [(0.8, 0.05 * k * side)]))
        after = [pilot.command(observe(1.0 + 0.1 * k, [])) for k in range(30)]
        assert all(np.hypot(c.vx_mps, c.vy_mps) < 1.0 for c in after)
        assert np.hypot(after[-1].vx_mps, after[-1].vy_mps) < 0.1
        assert sum(c.yaw_rate_radps for c in after) * side > 0


@pytest.mark.parametrize("apparent_m", [0.3, 1.0])
def test_pilot_does_not_follow_a_spot_in_the_image(apparent_m: float) -> None:
    """A spot that the network takes for a peer keeps its apparent distance during all motion."""
    pilot, way_m, vx_mps = Follow(TASK), 0.0, 0.0
    fly(pilot, [(0.7, 0.0)])
    for k in range(200):
        seen = observe(1.0 + 0.1 * k, [(apparent_m, 0.0)], confidence=0.2)
        command = pilot.command(replace(seen, velocity_mps=np.array([vx_mps, 0.0])))
        vx_mps = min(max(command.vx_mps, -1.0), 1.0)
        way_m += 0.1 * vx_mps
    assert abs(way_m) < 4.0


@pytest.mark.parametrize(("v_px", "depth_m"), [(200.0, 0.25), (30.0, 0.25)])
def test_weak_detections_above_or_below_the_leader_are_ignored(v_px: float, depth_m: float) -> None:
    pilot, way_m, vx_mps = Follow(TASK), 0.0, 0.0
    fly(pilot, [(0.7, 0.0)])
    spot = (AIDECK_PINHOLE.cx_px, v_px, depth_m, 0.15)
    for k in range(30):
        seen = observe(1.0 + 0.1 * k, [])
        seen = replace(seen, detections=(spot,), velocity_mps=np.array([vx_mps, 0.0]))
        vx_mps = min(max(pilot.command(seen).vx_mps, -1.0), 1.0)
        way_m += 0.1 * vx_mps
    assert abs(way_m) < 0.3


def test_pilot_leaves_a_weak_spot_for_a_sure_leader_elsewhere() -> None:
    """A weak false detection at the expected position does not hide the leader."""
    pilot = Follow(TASK)
    fly(pilot, [(0.7, 0.0)])
    commands = []
    for k in range(30):
        spot, leader = (
            observe(1.0 + 0.1 * k, [place], confidence).detections
            for place, confidence in (((0.75, 0.0), 0.2), ((1.1, -0.4), 0.9))
        )
        seen = replace(observe(1.0 + 0.1 * k, []), detections=(*leader, *spot))
        commands.append(pilot.command(seen))
    assert abs(commands[0].yaw_rate_radps) < 0.2  # a single image is not enough
    assert commands[-1].yaw_rate_radps < -0.5 and commands[-1].vx_mps > 0.2


def test_pilot_does_not_turn_away_while_detections_are_missing() -> None:
    """The network may miss a leader that is still ahead, so it stays in view for 2.5 s."""
    pilot, yaw_rad, rate = Follow(TASK), 0.0, 0.0
    fly(pilot, [(0.7, 0.0)])
    yaws = []
    for k in range(60):
        seen = replace(observe(1.0 + 0.1 * k, []), yaw_rate_radps=rate)
        rate = pilot.command(seen).yaw_rate_radps
        yaw_rad += 0.1 * rate
        yaws.append(yaw_rad)
    assert max(np.abs(yaws[:25])) < 0.68 < -min(yaws) < 3.0


def test_another_robot_in_view_is_not_followed() -> None:
    pilot = Follow(TASK)
    fly(pilot, [(0.8, 0.0)])
    assert abs(fly(pilot, [(0.8, 0.0), (1.6, 1.2)], first=10)[-1].yaw_rate_radps) < 0.1
    assert abs(pilot.command(observe(2.0, [(1.6, 1.2)])).yaw_rate_radps) < 0.1


def test_every_pilot_moves_away_from_a_peer_that_is_too_near() -> None:
    for form in PILOTS.values():
        pilot = form(TASK)
        for k in range(10):
            seen = observe(0.1 * k, [(0.3, 0.0)])
            seen = Observation(
                seen.time_s, 0.0, 0.0, 0.0, np.zeros(2), 1.0, {}, (build_track(0.3, 0.0),), 0.0,
                seen.detections,
            )  # fmt: skip
            command = pilot.command(seen)
        assert command.vx_mps < 0
    assert KeepApart(TASK).command(observe(0.0, [(1.0, 0.0)])) == Command()


def test_a_place_in_a_formation_does_not_turn_with_the_robot() -> None:
    pilot = Formation(TASK)
    straight = fly(pilot, [(0.7, 0.0)])[-1]
    assert np.hypot(straight.vx_mps, straight.vy_mps) < 0.1 and straight.vz_mps > 0.05
    # The robot has turned left by 90 degrees, but its place is still behind the leader.
    turned = Formation(TASK)
    for k in range(11):
        rate = 10 * np.pi / 2 / 10
        turned.command(Observation(0.1 * k, 0.0, 0.0, rate * (k > 0), np.zeros(2), 1.0))
    assert turned._filter.aim(0.0, -0.7, 0.7) == pytest.approx((0.0, 0.0), abs=0.05)


def test_pilots_are_found_by_name() -> None:
    assert find_pilot("follow") is Follow
    with pytest.raises(SettingError, match=r"no pilot nobody. Choose one of: .*keep_apart"):
        find_pilot("nobody")
    with pytest.raises(TypeError):
        Pilot(TASK)  # type: ignore[abstract]
