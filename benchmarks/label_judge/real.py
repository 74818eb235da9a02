"""Recordings of real flights: pairs of NanoBench flights, and ranges of the TIERS group."""

from itertools import combinations
from pathlib import Path

import numpy as np

from dmrl import topics
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.samples.flight import START_NS

OFFSET_M = 0.35
"""Offset of the TIERS group's ranges from antenna delays, metres."""
MOVING = ("turtle1", "turtle3", "turtle4")
TRUTH_HZ, SEED = 20.0, 40


def count_pairs(data: Path) -> int:
    """Return the number of pairs of NanoBench flights."""
    return len(list(combinations(sorted((data / "nanobench").glob("*.csv")), 2)))


def write_real(row: str, number: int, data: Path, path: Path) -> None:
    """Write a real flight as a recording."""
    if row == "TIERS":
        _convert_tiers(data / "uwb-tiers" / "4robots_data_01.npz", path)
    else:
        _write_pair(number, data / "nanobench", path)


def _convert_tiers(source: Path, path: Path) -> None:
    """Convert a source to a recording."""
    from dmrl.stages import convert  # noqa: PLC0415  # starts slowly

    convert.run(source, path, convert.Settings())


def _write_pair(number: int, folder: Path, path: Path) -> None:
    """Write two real flights as one pair with simulated ranges, like `bench_real_odometry`."""
    import bench_real_odometry as odometry  # noqa: PLC0415  # it imports the estimators

    files = sorted(folder.glob("*.csv"))
    first, second = list(combinations(files, 2))[number]
    rng = np.random.default_rng([SEED, number])
    one, other = odometry.read(first), odometry.move_aside(odometry.read(second), rng)
    end_s = min(one.time_s[-1], other.time_s[-1])
    if number % odometry.EVERY == odometry.EVERY - 1:
        other = odometry.add_crash(other, end_s - odometry.CRASH_S)
    time_s, range_m = odometry.simulate_ranges(one, other, rng)
    forwards = rng.random(len(time_s)) < 0.5
    moments_s = np.arange(0.0, end_s, 1 / TRUTH_HZ)
    settings = {"pair": [first.name, second.name], "seed": SEED}
    with RecordingWriter(path, Provenance("judge", settings), recipe="") as sink:

        def add(topic: str, message: str, at_s: np.ndarray, **columns: np.ndarray) -> None:
            log_ns = START_NS + np.rint(at_s * 1e9).astype(np.int64)
            sink.write_columns(topic, message_class(message), log_ns, columns)

        for robot, peer, flown, away, mine in (
            ("cf1", "cf2", one, other, forwards),
            ("cf2", "cf1", other, one, ~forwards),
        ):
            at_s, attitude = flown.log.attitude
            names = ("roll_rad", "pitch_rad", "yaw_rate_radps")
            columns = dict(zip(names, attitude.T, strict=True))
            add(topics.ATTITUDE(robot), "Attitude", at_s, **columns)
            at_s, velocity = flown.log.velocity
            columns = dict(zip(("vx_mps", "vy_mps"), velocity.T, strict=True))
            add(topics.VELOCITY(robot), "Velocity", at_s, **columns)
            at_s, height = flown.log.height
            add(topics.HEIGHT(robot), "Height", at_s, height_m=np.ravel(height))
            add(topics.RANGE(robot, peer), "UwbRange", time_s[mine], range_m=range_m[mine])
            x, y = odometry.compute_truth(flown, away, moments_s).T
            exact = np.zeros((len(x), 9))
            add(topics.TRUTH(robot, peer), "PeerPosition", moments_s, x=x, y=y, covariance=exact)
