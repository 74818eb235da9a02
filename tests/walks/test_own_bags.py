"""Bags of three simulated robots with motion capture are converted, aligned and labelled.

The tests cover the three formats of bags, velocities in the frame of odometry, clocks that start
at boot, and a log that starts before time zero.
"""

from pathlib import Path

import numpy as np
import pytest

from dmrl.evaluation import positions
from dmrl.flight import Scenario, simulate
from dmrl.flight.flight_arrays import Flight
from dmrl.flight.noise import NOISE
from dmrl.recording import LoadedRecording, check, read_summary, read_table
from dmrl.stages import align, convert, label
from dmrl.terminal.left_out import count_left_out

from .own_bags import Bag

pytestmark = pytest.mark.slow
ROBOTS = ("cf1", "cf2", "cf3")


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Return a simulated flight of three robots over 40 s."""
    return simulate(Scenario(robots=3, duration_s=40.0), NOISE["calibrated"], seed=21)


def convert_and_check(source: Path, out: Path) -> Path:
    """Convert a bag to a recording without findings; return it."""
    convert.run(source, out, convert.Settings())
    assert not check(out)
    return out


@pytest.mark.parametrize("kind", ["sqlite3", "mcap", "ros1"])
def test_all_bag_formats_give_equal_recordings(flight: Flight, tmp_path: Path, kind: str) -> None:
    if kind == "ros1":
        bag = Bag(flight, version=1).write(tmp_path / "flight.bag")
    else:
        bag = Bag(flight).write(tmp_path / "flight", kind)
    out = convert_and_check(bag, tmp_path / "flight.mcap")
    for robot in ROBOTS:
        log, every = flight.robots[robot], slice(None, None, 2)
        velocity = read_table(out, f"/{robot}/velocity")
        attitude = read_table(out, f"/{robot}/attitude")
        for field in ("vx_mps", "vy_mps"):
            np.testing.assert_allclose(velocity[field], getattr(log, field)[every], atol=1e-5)
        for field in ("roll_rad", "pitch_rad", "yaw_rate_radps"):
            np.testing.assert_allclose(attitude[field], getattr(log, field)[every], atol=1e-5)
    # Each pair of robots has ranges both ways, and no robot is called "uwb".
    links = [topic for topic in read_summary(out).topics if "/range/" in topic]
    assert links == sorted(f"/{a}/range/{b}" for a in ROBOTS for b in ROBOTS if a != b)


def test_odometry_velocities_are_rotated_to_the_robot(flight: Flight, tmp_path: Path) -> None:
    bag = Bag(flight, moving_frame="world").write(tmp_path / "flight")
    out = convert_and_check(bag, tmp_path / "flight.mcap")
    velocity = read_table(out, "/cf2/velocity")
    np.testing.assert_allclose(velocity["vx_mps"], flight.robots["cf2"].vx_mps[::2], atol=1e-5)
    label.run(out, tmp_path / "labelled.mcap", label.Settings())
    judged = positions.judge(tmp_path / "labelled.mcap")
    assert len(judged) == 6  # judged by the motion capture of the bag
    kept = np.concatenate([np.hypot(*p.judged.error_m[p.judged.kept].T) for p in judged])
    assert len(kept) > 2000 and np.median(kept) < 0.12


@pytest.mark.parametrize("reference", ["cf2", "mocap"])
def test_robots_with_boot_clocks_are_aligned(
    flight: Flight, tmp_path: Path, reference: str
) -> None:
    born_s = {"cf1": 12.5, "cf2": 70.0, "cf3": 300.25}
    bag = Bag(flight, born_s=born_s).write(tmp_path / "flight")
    convert.run(bag, tmp_path / "flight.mcap", convert.Settings())
    assert [f for f in check(tmp_path / "flight.mcap") if "shares no time" in f.text]
    settings = align.Settings(reference=reference, mocap=reference == "mocap")
    clocks = align.run(tmp_path / "flight.mcap", tmp_path / "aligned.mcap", settings)
    held = LoadedRecording(tmp_path / "aligned.mcap")
    born = {**born_s, "mocap": 1_772_000_000.0}
    for robot in set(clocks) & set(ROBOTS):
        error_s = clocks[robot].offset_s - (born[reference] - born_s[robot])
        assert abs(error_s) <= min(4 * clocks[robot].sigma_s, 0.05), robot
    starts = {r: held.get_times(f"/{r}/attitude")[0] for r in ROBOTS}
    assert max(starts.values()) - min(starts.values()) < 50_000_000
    if reference == "mocap":
        label.run(tmp_path / "aligned.mcap", tmp_path / "labelled.mcap", label.Settings())
        judged = positions.judge(tmp_path / "labelled.mcap")
        kept = np.concatenate([np.hypot(*p.judged.error_m[p.judged.kept].T) for p in judged])
        assert np.median(kept) < 0.12


def test_times_before_zero_are_left_out_and_counted(flight: Flight, tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    folder.mkdir()
    for robot, peer in (("cf1", "cf2"), ("cf2", "cf1")):
        log, ranges = flight.robots[robot], flight.ranges[robot, peer]
        columns = "time_s,roll_rad,pitch_rad,yaw_rate_radps,vx_mps,vy_mps,height_m"
        there = np.interp(log.time_s, ranges.time_s, ranges.range_m)
        values = [getattr(log, name) for name in columns.split(",")]
        rows = np.column_stack([values[0] - 5.0, *values[1:], there])
        text = "\n".join(",".join(f"{v:.6f}" for v in row) for row in rows)
        (folder / f"{robot}.csv").write_text(f"{columns},range_{peer}_m\n{text}\n")
    with count_left_out() as left_out:
        convert.run(folder, tmp_path / "flight.mcap", convert.Settings())
    (count,) = (n for why, n in left_out.counts.items() if "before 0" in why)
    early = sum(int((flight.robots[robot].time_s < 5.0).sum()) for robot in ("cf1", "cf2"))
    assert count == early
