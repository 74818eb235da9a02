"""Sensor logs of pairs, and the warnings about what is left out."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.errors import SourceError
from dmrl.estimation.model.pair import GRID_RATE_HZ
from dmrl.labelling.flight_log import read_flight
from dmrl.labelling.sensor_logs import MIN_RANGES, RobotLog, SensorLogs, build_sensor_logs
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.terminal.left_out import count_left_out

START_NS = 7_000_000_000
Write = Callable[[float, str, Any], None]


def write_flight(
    write: Write,
    robots: tuple[str, ...] = ("cf1", "cf2"),
    until_s: float = 8.0,
    from_s: float = 0.0,
) -> None:
    """Write the sensors of some robots at 20 Hz; values grow with time."""
    for time_s in np.arange(from_s, until_s, 0.05).tolist():
        for robot in robots:
            turn = {"roll_rad": 0.01 * time_s, "pitch_rad": 0.02, "yaw_rate_radps": 0.03 * time_s}
            write(time_s, topics.ATTITUDE(robot), message_class("Attitude")(**turn))
            moving = message_class("Velocity")(vx_mps=0.1 * time_s, vy_mps=-0.2 * time_s)
            write(time_s, topics.VELOCITY(robot), moving)
            write(time_s, topics.HEIGHT(robot), message_class("Height")(height_m=1 + 0.1 * time_s))


def write_ranges(write: Write, one: str = "cf1", other: str = "cf2", count: int = 40) -> None:
    """Write ranges that grow, one every 0.15 s."""
    for k in range(count):
        write(
            0.1 + 0.15 * k,
            topics.RANGE(one, other),
            message_class("UwbRange")(range_m=2.0 + k / 100),
        )


def read_logs(path: Path, *parts: Callable[[Write], None], offset_m: float = 0.0) -> SensorLogs:
    """Write a recording with some parts, and read its sensor logs."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for part in parts:
            part(lambda t, topic, m: sink.write(START_NS + round(t * 1e9), topic, m))
    return build_sensor_logs(read_flight(path), offset_m)


def test_pair_has_one_time_grid_and_ranges_of_both_robots(tmp_path: Path) -> None:
    back = lambda write: write_ranges(write, "cf2", "cf1", 30)  # noqa: E731
    found = read_logs(tmp_path / "a.mcap", write_flight, write_ranges, back, offset_m=0.5)
    assert (found.start_ns, found.warnings, found.flying) == (START_NS, [], {"cf1", "cf2"})
    pair = found.pairs["cf1", "cf2"]
    assert len(pair.range_m) == 70
    assert (np.diff(pair.range_time_s) >= 0).all()
    assert (pair.range_m.min(), pair.range_m.max()) == pytest.approx((1.5, 1.89))
    # Ranges of both robots are sorted by time.
    assert pair.range_m == pytest.approx(1.5 + (pair.range_time_s - 0.1) / 15)
    assert np.diff(pair.time_s) == pytest.approx(1 / GRID_RATE_HZ)
    middle = slice(20, -20)
    time_s = pair.time_s[middle]
    for track in (pair.own, pair.peer):
        assert track.vx_mps[middle] == pytest.approx(0.1 * time_s, abs=0.01)
        assert track.vy_mps[middle] == pytest.approx(-0.2 * time_s, abs=0.01)
        assert track.yaw_rate_radps[middle] == pytest.approx(0.03 * time_s, abs=0.003)
        assert track.height_m[middle] == pytest.approx(1 + 0.1 * time_s, abs=0.01)
        assert not track.dropout.any()


def test_a_log_lasts_as_long_as_all_of_its_sensors() -> None:
    def sensor(start_s: float, end_s: float) -> tuple[Any, Any]:
        return np.array([start_s, end_s]), np.zeros((2, 3))

    log = RobotLog(sensor(1, 9), sensor(2, 8), sensor(0, 7))
    assert (log.start_s, log.end_s) == (2, 7)


def test_heights_are_smoothed_over_half_a_second_without_bending_a_climb() -> None:
    time_s = np.arange(0, 10, 0.05)
    rng = np.random.default_rng(0)
    still = (time_s, np.zeros((len(time_s), 3)))
    climb_m = 0.2 * time_s + 0.05 * time_s**2
    noise_m = rng.normal(0, 0.02, len(time_s))
    for extra_m, most_m in ((0 * noise_m, 1e-4), (noise_m, 0.012)):
        track = RobotLog(still, still, (time_s, (climb_m + extra_m)[:, None])).to_track(time_s)
        assert np.std((track.height_m - climb_m)[50:-50]) < most_m


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"roll_rad": 0.9}, ["/cf1/attitude: roll_rad"]),
        ({"yaw_rate_radps": -7.0}, ["/cf1/attitude: yaw_rate_radps"]),
        ({"pitch_rad": -0.7, "yaw_rate_radps": 5.0}, []),
    ],
)
def test_values_that_look_like_degrees_are_reported(
    tmp_path: Path, change: dict[str, float], said: list[str]
) -> None:
    def steep(write: Write) -> None:
        for time_s in np.arange(0, 8, 0.05).tolist():
            write(time_s, topics.ATTITUDE("cf1"), message_class("Attitude")(**change))
            write(time_s, topics.VELOCITY("cf1"), message_class("Velocity")())
            write(time_s, topics.HEIGHT("cf1"), message_class("Height")())

    only_cf2 = lambda write: write_flight(write, ("cf2",))  # noqa: E731
    warnings = read_logs(tmp_path / "a.mcap", steep, only_cf2, write_ranges).warnings
    assert [": ".join(warning.split(": ")[:2]) for warning in warnings] == said


def omit_topic(kind: str) -> Callable[[Write], None]:
    """Return a function like `write_flight` that omits topics with this word."""
    return lambda write: write_flight(
        lambda t, topic, m: None if kind in topic else write(t, topic, m)
    )


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        (
            [omit_topic("cf2/velocity"), write_ranges],
            ["cf2: no /cf2/velocity; its pairs are left out"],
        ),
        (
            [lambda w: write_flight(w, until_s=4.9), write_ranges],
            ["cf1-cf2: their logs share 4.9 s, under 5 s; left out. Do their clocks agree?"],
        ),
        (
            [lambda w: write_flight(w, from_s=3.0, until_s=7.33), write_ranges],
            ["cf1-cf2: their logs share 4.3 s, under 5 s; left out. Do their clocks agree?"],
        ),
        (
            [write_flight, lambda w: write_ranges(w, count=MIN_RANGES - 1)],
            [f"cf1-cf2: {MIN_RANGES - 1} usable ranges, under {MIN_RANGES}; left out"],
        ),
    ],
    ids=["no velocity", "short", "late and short", "few ranges"],
)
def test_omitted_pairs_are_reported(tmp_path: Path, parts: list[Any], said: list[str]) -> None:
    found = read_logs(tmp_path / "a.mcap", *parts)
    assert not found.pairs
    assert found.warnings == said


def test_the_grid_covers_the_time_that_both_logs_share(tmp_path: Path) -> None:
    early = lambda write: write_flight(write, ("cf1",))  # noqa: E731
    late = lambda write: write_flight(write, ("cf2",), until_s=9.0, from_s=2.0)  # noqa: E731
    found = read_logs(tmp_path / "a.mcap", early, late, write_ranges)
    time_s = found.pairs["cf1", "cf2"].time_s
    assert (time_s[0], time_s[-1]) == pytest.approx((2.0, 7.95), abs=1.01 / GRID_RATE_HZ)


@pytest.mark.parametrize("kind", ["attitude", "velocity", "height"])
def test_sensor_with_only_nan_is_omitted(tmp_path: Path, kind: str) -> None:
    def spoilt(write: Write) -> None:
        def one(t: float, topic: str, m: Any) -> None:
            for field in m.DESCRIPTOR.fields if topic == f"/cf2/{kind}" else ():
                setattr(m, field.name, float("nan"))
            write(t, topic, m)

        write_flight(one)

    found = read_logs(tmp_path / "a.mcap", spoilt, write_ranges)
    assert not found.pairs and set(found.robots) == {"cf1"}
    assert f"/cf2/{kind}: nothing to use; its pairs are left out" in found.warnings


def test_the_minimum_number_of_ranges_makes_a_pair(tmp_path: Path) -> None:
    found = read_logs(
        tmp_path / "a.mcap", write_flight, lambda w: write_ranges(w, count=MIN_RANGES)
    )
    assert len(found.pairs["cf1", "cf2"].range_m) == MIN_RANGES


def test_silence_of_a_sensor_is_a_gap_of_its_robot_only(tmp_path: Path) -> None:
    def silent(write: Write) -> None:
        def loud(t: float, topic: str, m: Any) -> None:
            if not (3.0 < t < 5.0 and topic == "/cf2/attitude"):
                write(t, topic, m)

        write_flight(loud)

    found = read_logs(tmp_path / "a.mcap", silent, write_ranges)
    pair = found.pairs["cf1", "cf2"]
    assert not pair.own.dropout.any()
    assert pair.peer.dropout[np.abs(pair.time_s - 4.0) < 0.5].all()
    (warning,) = found.warnings
    assert warning.startswith("cf1-cf2: cf2 is silent for ")
    assert warning.endswith(" s; unconverged there")


def test_robot_with_log_but_no_pair_is_reported(tmp_path: Path) -> None:
    three = lambda write: write_flight(write, ("cf1", "cf2", "cf3"))  # noqa: E731
    found = read_logs(tmp_path / "a.mcap", three, write_ranges)
    assert found.flying == {"cf1", "cf2", "cf3"}
    assert found.warnings == [
        "cf3: it has a log but no position, so no image counts as one without it"
    ]


def test_non_finite_samples_and_backward_clocks_are_reported(tmp_path: Path) -> None:
    def bad(write: Write) -> None:
        for time_s, height_m in ((8.0, float("nan")), (8.01, -1e300)):
            write(time_s, topics.HEIGHT("cf1"), message_class("Height")(height_m=height_m))
        write(8.0, topics.RANGE("cf1", "cf2"), message_class("UwbRange")(range_m=70.0))

    path = tmp_path / "a.mcap"
    with count_left_out() as left_out:
        found = read_logs(path, write_flight, write_ranges, bad)
    (doubt,) = found.warnings
    assert doubt.endswith("values are over 30000 m, which no flight gives")
    assert left_out.counts == {
        "samples of /cf1/height that are not finite, or 1e+06 and more": 2,
        "ranges of cf1-cf2 that are not in (0, 60] m": 1,
    }
    with pytest.raises(SourceError, match="drop --strict"), count_left_out(strict=True):
        build_sensor_logs(read_flight(path))
    with RecordingWriter(tmp_path / "b.mcap", Provenance("test")) as sink:
        late = lambda t, topic, m: sink.write(  # noqa: E731
            START_NS + round(t * 1e9),
            topic,
            m,
            publish_ns=START_NS + round((t - 3 * (t > 4)) * 1e9),
        )
        write_flight(late)
        write_ranges(late)
    back = build_sensor_logs(read_flight(tmp_path / "b.mcap")).warnings
    assert "/cf1/attitude: its clock goes back 1 times; samples overlap there" in back
