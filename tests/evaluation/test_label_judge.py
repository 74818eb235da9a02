"""The label benchmark: injected faults change the named signals, and figures are correct."""

from pathlib import Path

import numpy as np
import pytest

from dmrl import topics
from dmrl.messages import STATUS_OK, STATUS_UNCONVERGED, message_class
from dmrl.recording import Provenance, RecordingWriter


@pytest.fixture(autouse=True)
def _judge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the label judge of the benchmarks importable."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))


@pytest.mark.heavy
def test_faults_change_signals_of_one_robot_and_no_truth() -> None:
    from label_judge.faults import ROWS  # noqa: PLC0415  # of benchmarks/
    from label_judge.flights import Base, fly  # noqa: PLC0415
    from label_judge.unlisted_rows import UNLISTED_ROWS  # noqa: PLC0415

    base = Base("room", "calibrated", 30.0, 1)
    assert len({row.name for row in ROWS}) == len(ROWS) > 90
    for row in (*ROWS, *UNLISTED_ROWS):
        logs, sound = fly(base), fly(base)
        row.inject(logs, row.size, np.random.default_rng(1))
        signals = [
            (logs.robots[robot][name], sound.robots[robot][name])
            for robot in sound.robots
            for name in sound.robots[robot]
        ] + [(logs.ranges[link], sound.ranges[link]) for link in sound.ranges]
        changed = [not np.array_equal(a, b, equal_nan=True) for a, b in signals]
        assert any(changed) != bool(row.motion), row.name
        for pair in sound.truth:
            assert np.array_equal(logs.truth[pair][:, 1:], sound.truth[pair][:, 1:]), row.name
        if row.robot and "clock" not in row.name and row.name != "bursts of bad ranges, gyro ramp":
            touched = {
                robot
                for robot in sound.robots
                for name in sound.robots[robot]
                if not np.array_equal(
                    logs.robots[robot][name], sound.robots[robot][name], equal_nan=True
                )
            }
            assert touched <= {row.robot}, row.name


def test_figures_of_a_flight_count_every_position(tmp_path: Path) -> None:
    from label_judge.figures import combine, judge_flight  # noqa: PLC0415

    path, beside = tmp_path / "a.mcap", tmp_path / "a.npz"
    made = message_class("PeerPosition")
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(100):
            at = 1_000_000_000 + k * 50_000_000
            sink.write(at, topics.TRUTH("cf1", "cf2"), made(x=1.0, y=0.5))
            covariance = np.diag([0.04, 0.04, 1.0]).ravel().tolist()
            # Twenty positions are kept, five of them with an error of 0.4 m; the rest have 0.6 m.
            status = STATUS_OK if k < 20 else STATUS_UNCONVERGED
            error = 0.0 if k < 15 else 0.4 if k < 20 else 0.6
            found = made(x=1.0 + error, y=0.5, covariance=covariance, status=status)
            sink.write(at, topics.POSITION("cf1", "cf2"), found)
    times = np.arange(100) * 0.05
    np.savez(beside, **{"cf1-cf2": np.tile(np.eye(2) * 0.005, (100, 1, 1)), "cf1-cf2-s": times})
    causes = [{"name": "yaw_rate_bias", "robot": "cf2", "probability": 0.9}]
    told = {"result": {"pairs": [{"causes": causes}], "warnings": []}}
    flight = judge_flight(path, beside, told)
    assert (flight.positions, flight.kept, flight.bad, flight.inside) == (100, 20, 5, 20)
    assert flight.keepable == {"0.01": 100.0, "0.02": 100.0}
    row = combine([flight], "yaw|gyro", [flight])
    assert row.rmse_m == pytest.approx(np.sqrt(0.05 * 0.16 + 0.8 * 0.36))
    assert row.sigma_m == pytest.approx(np.sqrt(0.08))
    assert row.bound_m == pytest.approx(0.1)
    assert (row.kept, row.bad, row.worst) == (0.2, 0.25, 0.25)
    assert (row.kept_of_limit, row.kept_of_sound) == (0.2, 1.0)
    assert (row.said, row.near, row.failed) == (1.0, 1.0, 0)
    missing = judge_flight(tmp_path / "none.mcap", beside, {"error": "there are no ranges"})
    row = combine([flight, missing], "height")
    assert (row.kept, row.failed, row.said, row.near) == (0.1, 1, 1.0, 0.0)
