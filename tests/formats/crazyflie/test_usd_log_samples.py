"""Samples of a micro-SD log: units, signs, and omissions."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.crazyflie import usd_log
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import count_left_out

from .. import foreign, plain_usd
from ..reading import group_by_topic


def read_samples(path: Path, options: Options | None = None) -> dict[str, list[Sample]]:
    """Return the samples of a log or folder by topic."""
    return group_by_topic(usd_log.load_content(path, options or Options()).samples)


def test_units_and_signs_follow_dmrl_conventions(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(foreign.pack_usd_log())
    found = read_samples(path, Options(robot="cf7", names={"2": "cf9"}))
    assert {topic: len(v) for topic, v in found.items()} == {
        "/cf7/attitude": 100,
        "/cf7/velocity": 100,
        "/cf7/height": 100,
        "/cf7/pose": 100,
        "/cf7/pose/truth": 20,
        "/cf7/range/cf3": 20,
        "/cf7/range/cf9": 100,
        "/cf7/log/fixedFrequency": 100,
        "/cf7/log/estPose": 20,
        "/cf7/log/estDistance": 20,
        "/tf": 20,
    }
    last = found["/cf7/velocity"][-1]
    yaw = 0.99  # the quaternion has z = sin(yaw / 2) = sin(0.005 k), k = 99
    assert last.time_ns == (1000 + 20 * 99) * 1_000_000
    assert last.fields["vx_mps"] == pytest.approx(0.5 * np.cos(yaw), abs=1e-6)
    assert last.fields["vy_mps"] == pytest.approx(-0.5 * np.sin(yaw), abs=1e-6)
    attitude = found["/cf7/attitude"][-1].fields
    assert attitude["yaw_rad"] == pytest.approx(yaw, abs=1e-6)
    assert attitude["yaw_rate_radps"] == pytest.approx(0.5, abs=1e-5)
    # Integers are millimetres, floats are metres.
    assert found["/cf7/range/cf9"][0].fields == {"range_m": 1.5}
    assert found["/cf7/range/cf3"][0].fields == {"range_m": 2.5}
    assert found["/cf7/log/fixedFrequency"][3].fields["pm_vbatMV"] == 3900


@pytest.mark.parametrize("logged", ["roll", "pitch"])
def test_sign_of_each_angle_is_checked_alone(tmp_path: Path, logged: str) -> None:
    names = ("roll", "pitch", "yaw")
    events = {1: ("state", [(f"stateEstimate.{name}", "f") for name in names])}
    values = tuple(10.0 if name == logged else 0.0 for name in names)
    path = tmp_path / "log"
    path.write_bytes(plain_usd.encode(events, [(1, 1000, values), (1, 2000, values)]))
    fields = read_samples(path)["/cf1/attitude"][0].fields
    # The Crazyflie logs pitch positive nose up, dmrl has it positive nose down.
    assert fields["roll_rad"] == pytest.approx(np.radians(values[0]))
    assert fields["pitch_rad"] == pytest.approx(-np.radians(values[1]))


def test_angles_and_quaternion_of_one_attitude_agree(tmp_path: Path) -> None:
    roll, pitch, yaw = 0.2, -0.3, 2.0
    cr, cp, cy = np.cos([roll / 2, pitch / 2, yaw / 2])
    sr, sp, sy = np.sin([roll / 2, pitch / 2, yaw / 2])
    quaternion = (
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
        cy * cp * cr + sy * sp * sr,
    )
    names = ("qx", "qy", "qz", "qw")
    events = {1: ("state", [(f"stateEstimate.{name}", "f") for name in names])}
    path = tmp_path / "log"
    path.write_bytes(plain_usd.encode(events, [(1, 1000, quaternion)]))
    fields = read_samples(path)["/cf1/attitude"][0].fields
    assert [fields[f"{n}_rad"] for n in ("roll", "pitch", "yaw")] == pytest.approx(
        [roll, pitch, yaw], abs=1e-6
    )


@pytest.mark.heavy
def test_the_gyroscope_of_a_real_flight_is_the_slope_of_its_attitude(data: Path) -> None:
    found = read_samples(data / "crazyflie-usd" / "eckart00_brushless_flights")["/cf1/attitude"]
    time = np.array([s.time_ns for s in found]) * 1e-9
    yaw = np.array([s.fields["yaw_rad"] for s in found])
    rate = np.array([s.fields["yaw_rate_radps"] for s in found])
    turned = np.concatenate([[0], np.cumsum(np.diff(time) * (rate[1:] + rate[:-1]) / 2)])
    assert np.abs(turned - (yaw - yaw[0])).max() < 0.05


@pytest.mark.heavy
def test_the_state_of_a_real_flight_is_where_motion_capture_saw_it(data: Path) -> None:
    found = read_samples(data / "crazyflie-usd" / "eckart00_brushless_flights")

    def track(topic: str) -> tuple[np.ndarray, np.ndarray]:
        places = [s.fields["pose"]["position"] for s in found[topic]]
        times = np.array([s.time_ns for s in found[topic]], float)
        return times, np.array([[p[axis] for axis in "xyz"] for p in places])

    time, state = track("/cf1/pose")
    true_time, truth = track("/cf1/pose/truth")
    at = np.stack([np.interp(true_time, time, axis) for axis in state.T], axis=1)
    error = np.linalg.norm(at - truth, axis=1)
    assert np.ptp(truth, axis=0).max() > 0.5  # the robot moves
    assert np.median(error) < 0.02 and error.max() < 0.15


def test_each_file_of_a_folder_is_a_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("cf1", "cf2"):
        (tmp_path / name).write_bytes(foreign.pack_usd_log())
    (tmp_path / "cf3").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("first flight")
    assert usd_log.can_read(tmp_path)
    found = read_samples(tmp_path)
    assert {"/cf1/attitude", "/cf2/attitude"} <= found.keys()
    err = capsys.readouterr().err
    assert "left out: empty files: 1" in err and "files that are no micro-SD log: 1" in err


def test_attitude_before_the_estimator_starts_is_left_out(tmp_path: Path) -> None:
    names = ("qx", "qy", "qz", "qw")
    events = {1: ("state", [(f"stateEstimate.{name}", "f") for name in names])}
    rows = [(1, 1000, (0.0, 0.0, 0.0, 0.0)), (1, 2000, (0.0, 0.0, 0.0, 1.0))]
    path = tmp_path / "log"
    path.write_bytes(plain_usd.encode(events, rows))
    found = read_samples(path)
    assert (len(found["/cf1/attitude"]), len(found["/cf1/log/state"])) == (1, 2)


def test_impossible_ranges_are_omitted_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    events = {1: ("range", [("ranging.distance2", "H")])}
    rows = [(1, 1000 * k, (value,)) for k, value in enumerate((0, 1500, 1500, 65535, 2000))]
    path = tmp_path / "log"
    path.write_bytes(plain_usd.encode(events, rows))
    got = [(s.time_ns, s.fields["range_m"]) for s in read_samples(path)["/cf1/range/cf2"]]
    assert got == [(1_000_000, 1.5), (4_000_000, 2.0)]  # a repeated value is not a new measurement
    assert (
        "left out: ranges to cf2 that are not over 0 and under 60 m: 1" in capsys.readouterr().err
    )


def _write_log(path: Path, variables: tuple[str, ...], *rows: tuple[float, ...]) -> Path:
    """Write a log of one event with a row every millisecond."""
    events = {1: ("state", [(name, "f") for name in variables])}
    path.write_bytes(plain_usd.encode(events, [(1, 1000 * k, row) for k, row in enumerate(rows)]))
    return path


def test_velocity_needs_yaw_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("stateEstimate.vx", "stateEstimate.vy", "stateEstimate.roll", "stateEstimate.yaw")
    log = _write_log(tmp_path / "log", names, (1.0, 0.0, 5.0, 90.0), (1.0, 0.0, 5.0, 90.0))
    found = read_samples(log)
    fields = found["/cf1/velocity"][0].fields
    assert (fields["vx_mps"], fields["vy_mps"]) == pytest.approx((0, -1), abs=1e-9)
    assert "/cf1/attitude" not in found
    assert "no attitude: no usable stateEstimate pitch." in capsys.readouterr().err


@pytest.mark.parametrize(
    ("variables", "reasons"),
    [
        (("gyro.x",), ("roll, pitch, yaw", "no velocity: no usable stateEstimate vx, vy")),
        (("stateEstimate.vx", "stateEstimate.vy"), ("roll, pitch, yaw", "no yaw to turn")),
        (("stateEstimate.yaw",), ("stateEstimate roll, pitch;", "no usable stateEstimate vx")),
    ],
)
def test_missing_attitude_or_velocity_reports_the_reason(
    variables: tuple[str, ...],
    reasons: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = read_samples(_write_log(tmp_path / "log", variables, (0.5,) * len(variables)))
    assert not {"/cf1/attitude", "/cf1/velocity"} & found.keys()
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and all(reason in err for reason in reasons)


@pytest.mark.heavy
def test_real_logs_without_pitch_keep_their_velocity(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = read_samples(data / "crazypad" / "motor-E8_log00")
    velocity = found["/cf1/velocity"]
    assert len(velocity) == 2601
    # The robot faces along x all the time, so that its position is the integral of vx.
    seconds = np.array([s.time_ns for s in velocity]) * 1e-9
    vx = np.array([s.fields["vx_mps"] for s in velocity])
    x = np.array([s.fields["pose"]["position"]["x"] for s in found["/cf1/pose"]])
    flown = np.concatenate([[0], np.cumsum(np.diff(seconds) * (vx[1:] + vx[:-1]) / 2)])
    assert np.ptp(x) > 2 and np.abs(flown - (x - x[0])).max() < 0.25
    assert "no attitude: no usable stateEstimate pitch." in capsys.readouterr().err


def test_files_that_are_no_log_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cf1").write_bytes(foreign.pack_usd_log())
    for name in ("a1", "a2", ".hidden"):
        (tmp_path / name).write_text("x")
    assert "/cf1/attitude" in read_samples(tmp_path)
    assert f"files that are no micro-SD log: 2 (first at {tmp_path / 'a1'})" in (
        capsys.readouterr().err
    )


STATE = [(f"stateEstimate.{n}", "f") for n in ("x", "y", "z", "roll", "pitch", "yaw")]


def write_states(path: Path, times_us: np.ndarray, x: np.ndarray) -> None:
    """Write a log of one event with these times, microseconds, and positions x, metres."""
    rows = [(1, int(t), (float(v), 0, 1, 0, 0, 0)) for t, v in zip(times_us, x, strict=True)]
    path.write_bytes(plain_usd.encode({1: ("state", STATE)}, rows))


def test_a_robot_that_started_again_is_refused_with_its_record(tmp_path: Path) -> None:
    flight = np.arange(300) * 10_000
    write_states(tmp_path / "log", np.concatenate([flight + 5_000_000, flight]), np.zeros(600))
    with pytest.raises(
        SourceError, match=r"log: state, record 301: time goes back from 7\.99 s to"
    ):
        read_samples(tmp_path / "log")


def test_records_whose_time_jumps_or_was_not_set_are_left_out(tmp_path: Path) -> None:
    times_us = np.arange(300) * 10_000 + 5_000_000
    for wrong in (0, 9_000_000_000_000):
        told = times_us.copy()
        told[100] = wrong
        write_states(tmp_path / "log", told, np.zeros(300))
        with count_left_out() as left_out:
            found = read_samples(tmp_path / "log")["/cf1/height"]
        assert [s.time_ns for s in found] == (np.delete(times_us, 100) * 1000).tolist()
        assert left_out.counts == {"rows whose time jumps and returns": 1}


def test_values_that_are_not_finite_are_counted_and_stay_in_the_log(tmp_path: Path) -> None:
    x = np.where(np.arange(300) % 3 == 0, np.nan, 1.0)
    write_states(tmp_path / "log", np.arange(300) * 10_000, x)
    with count_left_out() as left_out:
        found = read_samples(tmp_path / "log")
    assert left_out.counts == {"values of stateEstimate.x that are not finite": 100}
    assert len(found["/cf1/pose"]) == 200 and len(found["/cf1/log/state"]) == 300
