"""Signs and frames are doubted where a recording has poses to hold them against."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dmrl import topics
from dmrl.geometry.turns import quaternion_zyx
from dmrl.messages import message
from dmrl.recording import Provenance, RecordingWriter, check

Columns = dict[str, NDArray[np.float64]]
TIME_S = np.arange(0.0, 30.0, 0.02)


def flown() -> tuple[Columns, Columns]:
    """What a robot measures, and its poses: a wide curve, with all that it turns."""
    x, y = 2 * np.sin(0.5 * TIME_S), 1.5 * np.sin(0.8 * TIME_S + 1)
    yaw = 1.4 * np.sin(0.3 * TIME_S) + 0.2 * TIME_S
    roll, pitch = 0.1 * np.sin(1.1 * TIME_S), 0.12 * np.cos(0.9 * TIME_S)
    vx, vy = np.gradient(x, TIME_S), np.gradient(y, TIME_S)
    c, s = np.cos(yaw), np.sin(yaw)
    rng = np.random.default_rng(3)
    noise = rng.normal(0, 0.02, (5, len(TIME_S)))
    measured = {
        "vx_mps": c * vx + s * vy + noise[0],
        "vy_mps": c * vy - s * vx + noise[1],
        "roll_rad": roll + noise[2],
        "pitch_rad": pitch + noise[3],
        "yaw_rate_radps": np.gradient(yaw, TIME_S) + noise[4],
    }
    turns = quaternion_zyx(np.column_stack([roll, pitch, yaw]))
    return measured, {"x": x, "y": y, **dict(zip(("qx", "qy", "qz", "qw"), turns.T, strict=True))}


def recorded(path: Path, said: Columns, poses: Columns, late_s: float = 0.0) -> list[str]:
    """What check says of it."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for k, time_s in enumerate(TIME_S):
            row = {name: float(values[k]) for name, values in said.items()}
            now = round((time_s + 1) * 1e9)
            velocity = {name: row[name] for name in ("vx_mps", "vy_mps")}
            turning = {name: row[name] for name in row if name not in velocity}
            sink.write(now, topics.velocity("cf1"), message("Velocity")(**velocity))
            sink.write(now, topics.attitude("cf1"), message("Attitude")(**turning))
            place = {"position": {axis: float(poses[axis][k]) for axis in "xy"}}
            turn = {"orientation": {axis: float(poses[f"q{axis}"][k]) for axis in "xyzw"}}
            pose = message("PoseInFrame")(frame_id="world", pose={**place, **turn})
            sink.write(now + round(late_s * 1e9), topics.true_pose("cf1"), pose)
    return [f"{finding.topic}: {finding.text}" for finding in check(path)]


def test_what_fits_is_not_doubted(tmp_path: Path) -> None:
    assert recorded(tmp_path / "a.mcap", *flown()) == []


def test_a_clock_that_is_a_little_off_is_no_wrong_sign(tmp_path: Path) -> None:
    assert recorded(tmp_path / "a.mcap", *flown(), late_s=0.3) == []


@pytest.mark.parametrize("name", ["roll_rad", "pitch_rad", "yaw_rate_radps"])
def test_another_sign(tmp_path: Path, name: str) -> None:
    measured, poses = flown()
    found = recorded(tmp_path / "a.mcap", measured | {name: -measured[name]}, poses)
    assert len(found) == 1 and f"/cf1/attitude: {name} has the other sign" in found[0]


def test_velocities_of_another_frame(tmp_path: Path) -> None:
    measured, poses = flown()
    vx, vy = measured["vx_mps"], measured["vy_mps"]
    wrong = {
        "does not turn": [np.gradient(poses[axis], TIME_S) for axis in "xy"],
        "to the right": [vx, -vy],
        "Forward seems to be negative": [-vx, vy],
        "Both seem": [-vx, -vy],
        "exchanged": [vy, vx],
    }
    for k, (words, (x, y)) in enumerate(wrong.items()):
        found = recorded(tmp_path / f"{k}.mcap", measured | {"vx_mps": x, "vy_mps": y}, poses)
        assert len(found) == 1 and words in found[0] and "/cf1/velocity" in found[0], words
