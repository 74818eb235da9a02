"""Mistakes of units, axes, signs and clocks in logs, found and corrected."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.evidence.mistakes import (
    MISTAKES,
    _search_shift,
    compute_misfit,
    find_mistake,
    has_camera,
    ranges_are_far,
)
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.model.pair import BearingMeasurements, Pair
from dmrl.messages import STATUS_OK

from ..flights import build_pair, build_two_way_pair, compute_truth, simulate_flight

BY_NAME = {mistake.name: mistake for mistake in MISTAKES}


def test_sign_correction_applies_to_one_robot() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    wrong = replace(pair, peer=replace(pair.peer, yaw_rate_radps=-pair.peer.yaw_rate_radps))
    again = BY_NAME["yaw rate fits if it is negated"].correct(wrong, 1)
    assert np.array_equal(again.peer.yaw_rate_radps, pair.peer.yaw_rate_radps)
    assert again.own is pair.own


def turn_to_take_off_frame(pair: Pair) -> Pair:
    """Return the pair with the peer's velocities in the horizontal frame of its take-off."""
    heading = np.cumsum(pair.peer.yaw_rate_radps) * pair.dt_s
    x, y = pair.peer.vx_mps, pair.peer.vy_mps
    vx, vy = np.cos(heading) * x - np.sin(heading) * y, np.sin(heading) * x + np.cos(heading) * y
    return replace(pair, peer=replace(pair.peer, vx_mps=vx, vy_mps=vy))


def test_velocities_in_the_take_off_frame_are_rotated_back() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    mistake = BY_NAME["flow fits in the world frame"]
    assert mistake.heading_is_open
    again = mistake.correct(turn_to_take_off_frame(pair), 1)
    assert again.peer.vx_mps == pytest.approx(pair.peer.vx_mps)
    assert again.peer.vy_mps == pytest.approx(pair.peer.vy_mps)


@pytest.mark.heavy
def test_corrections_that_leave_headings_open_win_among_similar_fits() -> None:
    """Here a yaw rate read as degrees is almost zero, and fits slightly better by chance."""
    wrong = turn_to_take_off_frame(build_pair(simulate_flight("in_view", "calibrated", 1002, 40.0)))
    as_degrees = BY_NAME["yaw rate fits if it is taken as degrees"].correct(wrong, 1)
    in_world = BY_NAME["flow fits in the world frame"]
    assert compute_misfit(as_degrees) < compute_misfit(in_world.correct(wrong, 1))
    assert find_mistake(wrong) == (in_world, 1, (1,))


@pytest.mark.parametrize(
    ("name", "names", "factor"),
    [
        ("flow fits if it is divided by 100", ("vx_mps", "vy_mps"), 100.0),
        ("flow fits if it is divided by 1000", ("vx_mps", "vy_mps"), 1000.0),
        ("flow fits if it is taken as feet", ("vx_mps", "vy_mps"), 1 / 0.3048),
        ("height fits if it is divided by 100", ("height_m",), 100.0),
        ("yaw rate fits if it is taken as degrees", ("yaw_rate_radps",), 180 / np.pi),
    ],
)
def test_a_unit_of_a_robot_is_corrected(name: str, names: tuple[str, ...], factor: float) -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    wrong = {key: factor * getattr(pair.peer, key) for key in names}
    mistake = BY_NAME[name]
    given = replace(pair, peer=replace(pair.peer, **wrong))
    again = mistake.correct(given, 1)
    for key in names:
        assert getattr(again.peer, key) == pytest.approx(getattr(pair.peer, key))
    if mistake.applies is not None:
        assert mistake.applies(given, 1)
        assert not mistake.applies(pair, 1) and not mistake.applies(given, 0)


def test_ranges_in_centimetres_are_corrected_and_fill_values_left_out() -> None:
    pair = build_two_way_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    fill = np.arange(len(pair.range_m)) == 3
    wrong = replace(pair, range_m=np.where(fill, 65535.0, 100 * pair.range_m))
    assert ranges_are_far(wrong) and not ranges_are_far(pair)
    again = BY_NAME["range fits if it is divided by 100"].correct(wrong, None)
    assert again.range_m == pytest.approx(pair.range_m[~fill])
    assert again.range_sender is not None and len(again.range_sender) == len(again.range_m)


@pytest.mark.parametrize("shift_s", [k / 4 for k in range(-19, 20) if k])
def test_a_shift_of_a_clock_is_found_to_a_quarter_of_a_second(shift_s: float) -> None:
    assert _search_shift(lambda tried_s: abs(tried_s - shift_s)) == shift_s


@pytest.mark.heavy
def test_ranges_in_feet_are_corrected_although_scales_explain_them() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 40.0))
    ((found, _),) = estimate_pairs([replace(pair, range_m=pair.range_m / 0.3048)])
    assert found.causes[0].name == "range fits if it is taken as feet"
    truth = compute_truth(simulate_flight("in_view", "calibrated", 1000, 40.0), found.time_s)
    assert np.hypot(*(found.state[:, :2] - truth).T).mean() < 0.2


@pytest.mark.heavy
@pytest.mark.parametrize("change", ["vx", "vy", "both"])
def test_a_mirrored_flow_leaves_the_heading_of_its_robot_open(change: str) -> None:
    flight = simulate_flight("in_view", "calibrated", 1001, 60.0)
    pair = build_pair(flight)
    vx, vy = pair.peer.vx_mps, pair.peer.vy_mps
    vx, vy = {"vx": (-vx, vy), "vy": (vx, -vy), "both": (vy, vx)}[change]
    wrong = replace(pair, peer=replace(pair.peer, vx_mps=vx, vy_mps=vy))
    ((own, peer),) = estimate_pairs([wrong])
    assert any(c.name.startswith("flow fits if one axis") and c.robot == 1 for c in own.causes)
    error = np.hypot(*(own.state[:, :2] - compute_truth(flight, own.time_s)).T)
    kept = own.status == STATUS_OK
    assert kept.mean() > 0.5 and (error[kept] < 0.5).all()
    assert not (peer.status == STATUS_OK).any()


@pytest.mark.heavy
def test_a_log_that_is_mirrored_leaves_the_side_of_both_robots_open() -> None:
    """With vy and yaw rate negated, mirroring the log of the other robot fits equally well."""
    pair = build_pair(simulate_flight("room", "calibrated", 1003, 60.0))
    own = pair.own
    wrong = replace(pair, own=replace(own, vy_mps=-own.vy_mps, yaw_rate_radps=-own.yaw_rate_radps))
    for estimate in estimate_pairs([wrong])[0]:
        cause = estimate.causes[0]
        assert cause.name == "odometry of one robot fits if vy and yaw rate are negated"
        assert cause.robot is None
        assert not (estimate.status == STATUS_OK).any()


def test_a_mistake_shows_in_a_log_without_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without noise the misfit is small even before the correction, but falls by it."""
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    wrong = replace(pair, peer=replace(pair.peer, yaw_rate_radps=-pair.peer.yaw_rate_radps))
    monkeypatch.setattr(
        "dmrl.estimation.evidence.mistakes.compute_misfit",
        lambda tried: (
            0.05 if np.array_equal(tried.peer.yaw_rate_radps, pair.peer.yaw_rate_radps) else 0.25
        ),
    )
    found = find_mistake(wrong)
    assert found is not None
    assert (found.mistake.name, found.robot) == ("yaw rate fits if it is negated", 1)


def test_a_camera_shows_which_axis_is_wrong() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    seen = BearingMeasurements(np.zeros(1), np.zeros((1, 1, 3)), np.ones((1, 1, 3)))
    assert not has_camera(pair, None) and not has_camera(pair, 0)
    looking = replace(pair, peer_bearings=seen)
    assert has_camera(looking, None) and has_camera(looking, 1) and not has_camera(looking, 0)


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["yaw rate fits if it is negated", "flow fits in the world frame"])
def test_a_mistake_in_the_logs_of_both_robots_is_named(name: str) -> None:
    wrong = build_two_way_pair(simulate_flight("room", "calibrated", 1001, 50.0))
    if "world" in name:
        wrong = turn_to_take_off_frame(turn_to_take_off_frame(wrong).swap_robots()).swap_robots()
    else:
        wrong = BY_NAME[name].correct(wrong, None)
    ((own, peer),) = estimate_pairs([wrong])
    assert own.causes[0].name == name.replace(" fits", " of both robots fits")
    assert own.causes[0].robot is None
    assert not (own.status == STATUS_OK).any() and not (peer.status == STATUS_OK).any()
