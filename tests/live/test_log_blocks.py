"""Log blocks of a Crazyflie: their layout, units and signs."""

import math

import pytest

from dmrl.errors import SettingError
from dmrl.live.log_blocks import (
    BLOCK_BYTES,
    LOG_TYPES,
    MAX_BLOCKS,
    VARIABLE_BYTES,
    LogDecoder,
    parse_robot_number,
    plan_blocks,
)

TOC = {
    **{f"stateEstimate.{name}": "float" for name in ("roll", "pitch", "yaw", "vx", "vy", "z")},
    **{f"gyro.{axis}": "float" for axis in "xyz"},
    "range.zrange": "uint16_t",
    "pm.vbat": "float",
    **{f"ranging.distance{k}": "float" for k in range(20)},
}
LEVEL = {f"stateEstimate.{name}": 0.0 for name in ("roll", "pitch", "yaw", "vx", "vy")} | {
    "gyro.z": 0.0
}


@pytest.mark.parametrize("peers", [0, 1, 5, 12, 20])
def test_blocks_fit_their_packet_and_hold_every_variable_once(peers: int) -> None:
    wanted = plan_blocks(TOC, {k: f"cf{k}" for k in range(peers)}, 10)
    assert all(0 < block.size <= BLOCK_BYTES for block in wanted.blocks)
    names = [v.name for block in wanted.blocks for v in block.variables]
    assert len(names) == len(set(names)) == 7 + 1 + peers + 1
    fast = [block for block in wanted.blocks if block.period_ms == 10]
    assert len(fast) == (2 if peers <= 5 else len(fast))


def test_variable_sizes_equal_cflib() -> None:
    elements = pytest.importorskip("cflib.crazyflie.log").LogTocElement.types
    assert {name: size for name, _, size in elements.values()} == VARIABLE_BYTES
    assert {name: kind for kind, (name, _, _) in elements.items()} == {
        name: kind for name, (kind, _) in LOG_TYPES.items()
    }


def test_a_drone_without_a_state_estimate_is_refused() -> None:
    with pytest.raises(SettingError, match=r"cf7 has no log variable stateEstimate\.roll"):
        plan_blocks({"pm.vbat": "float"}, {}, 10, robot="cf7")


def test_without_a_height_estimate_the_laser_is_taken_in_millimetres() -> None:
    reading = LogDecoder(
        "cf1", plan_blocks({k: v for k, v in TOC.items() if k != "stateEstimate.z"}, {}, 10)
    )
    (height,) = reading.iter_samples(5, {"range.zrange": 432})
    assert height.fields == {"height_m": 0.432}


def test_pitch_changes_its_sign_and_velocity_turns_with_the_robot() -> None:
    reading = LogDecoder("cf1", plan_blocks(TOC, {}, 10))
    values = LEVEL | {"stateEstimate.pitch": 10.0, "stateEstimate.roll": 5.0}
    values |= {"stateEstimate.yaw": 90.0, "stateEstimate.vx": 0.0, "stateEstimate.vy": 2.0}
    attitude, velocity = reading.iter_samples(5, values)
    assert attitude.fields["pitch_rad"] == pytest.approx(-math.radians(10))
    assert attitude.fields["roll_rad"] == pytest.approx(math.radians(5))
    # The robot faces and moves along the world's y, hence along its own x.
    assert velocity.fields["vx_mps"] == pytest.approx(2.0)
    assert velocity.fields["vy_mps"] == pytest.approx(0.0)


def test_the_turning_rate_is_about_the_vertical_not_the_body() -> None:
    reading = LogDecoder("cf1", plan_blocks(TOC, {}, 10))
    roll, rate = math.radians(20), math.radians(60)
    # The robot turns about the vertical at 60 deg/s while it is rolled by 20 degrees.
    values = LEVEL | {"stateEstimate.roll": 20.0}
    values |= {"gyro.y": 60 * math.sin(roll), "gyro.z": 60 * math.cos(roll)}
    attitude, _ = reading.iter_samples(5, values)
    assert attitude.fields["yaw_rate_radps"] == pytest.approx(rate)


@pytest.mark.parametrize(("kind", "unit"), [("float", 1.0), ("uint16_t", 1000)])
def test_only_a_changed_distance_is_a_ranging(kind: str, unit: float) -> None:
    toc = TOC | {"ranging.distance2": kind}
    reading = LogDecoder("cf1", plan_blocks(toc, {2: "cf2"}, 10))
    logged = [0.0, 1.5, 1.5, 1.25, 1.25, 65.535, 1.0]
    got = [
        sample.fields["range_m"]
        for value in logged
        for sample in reading.iter_samples(0, {"ranging.distance2": value * unit})
    ]
    assert got == [1.5, 1.25, 1.0]


def test_values_that_are_no_numbers_are_left_out() -> None:
    reading = LogDecoder("cf1", plan_blocks(TOC, {1: "cf1"}, 10))
    values = LEVEL | {"stateEstimate.vx": math.nan, "stateEstimate.z": math.inf}
    assert list(reading.iter_samples(5, values)) == []


def test_robots_are_numbered_by_the_end_of_their_names() -> None:
    assert [parse_robot_number(name) for name in ("cf2", "drone10", "leader")] == [2, 10, None]


def test_limits_of_blocks_equal_those_of_cflib() -> None:
    assert pytest.importorskip("cflib.crazyflie.log").LogConfig.MAX_LEN == BLOCK_BYTES
    assert pytest.importorskip("cflib.crazyflie.log").Log.MAX_BLOCKS == MAX_BLOCKS


def test_turning_about_the_vertical_is_found_at_any_tilt() -> None:
    reading = LogDecoder("cf1", plan_blocks(TOC, {}, 10))
    for roll_deg, pitch_deg in ((20.0, 0.0), (0.0, 15.0), (-25.0, 10.0)):
        # The logged pitch is positive nose up. The attitude is Ry(pitch) Rx(roll).
        roll, pitch = math.radians(roll_deg), -math.radians(pitch_deg)
        values = LEVEL | {"stateEstimate.roll": roll_deg, "stateEstimate.pitch": pitch_deg}
        values |= {"gyro.y": 60 * math.cos(pitch) * math.sin(roll)}
        values |= {"gyro.z": 60 * math.cos(pitch) * math.cos(roll)}
        attitude, _ = reading.iter_samples(5, values)
        assert attitude.fields["yaw_rate_radps"] == pytest.approx(math.radians(60))
