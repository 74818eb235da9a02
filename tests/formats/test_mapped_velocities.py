"""Velocities of a CSV file are converted from the frame of its column map to the horizontal one."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.files import mapped_csv
from dmrl.geometry.frames import camera_from_horizontal

ANGLE = st.floats(-1.4, 1.4)
NAMES = ("time", "roll", "pitch", "yaw", "vx", "vy", "vz", "yaw_rate")
UNITS = {"time": "s", "yaw_rate": "rad/s"} | dict.fromkeys(("roll", "pitch", "yaw"), "rad")


def write_log(
    folder: Path, frame: str, rows: np.ndarray, names: tuple[str, ...] = NAMES
) -> Options:
    """Write a log with these rows, and its column map; return the options to read it."""
    lines = [",".join(names), *(",".join(repr(float(x)) for x in row) for row in rows)]
    (folder / "a.csv").write_text("\n".join(lines) + "\n")
    text = ""
    for name in names:
        frames = f'frame = "{frame}"\n' if name[0] == "v" else ""
        text += f'[{name}]\nname = "{name}"\nunit = "{UNITS.get(name, "m/s")}"\n{frames}'
    (folder / "a.toml").write_text(text)
    return Options(columns=folder / "a.toml")


def read_velocities(folder: Path, options: Options) -> np.ndarray:
    """Return the (N, 2) or (N, 3) velocities of the log, m/s."""
    found = mapped_csv.load_content(folder / "a.csv", options).samples
    return np.array([list(s.fields.values()) for s in found if s.message == "Velocity"])


@given(ANGLE, ANGLE, st.floats(-3, 3), st.lists(st.floats(-2, 2), min_size=3, max_size=3))
@pytest.mark.heavy
def test_a_velocity_of_any_frame_becomes_one_in_the_horizontal_frame(
    tmp_path_factory: pytest.TempPathFactory, roll: float, pitch: float, yaw: float, v: list[float]
) -> None:
    folder = tmp_path_factory.mktemp("velocities")
    c, s = np.cos(yaw), np.sin(yaw)
    heading = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    level = {"world": heading.T, "horizontal": np.eye(3)}
    level["body"] = camera_from_horizontal(roll, pitch).T
    rows = np.array([[k, roll, pitch, yaw, *v, 0.0] for k in range(3)])
    for frame, turned in level.items():
        found = read_velocities(folder, write_log(folder, frame, rows))
        assert found == pytest.approx(np.tile(turned @ v, (3, 1)), abs=1e-9)


def test_a_velocity_in_the_horizontal_frame_needs_no_yaw(tmp_path: Path) -> None:
    rows = np.array([[0.02 * k, 0.0, 0.0, 1.0, 0.5, 0.3] for k in range(5)])
    names = ("time", "roll", "pitch", "vx", "vy", "yaw_rate")
    options = write_log(tmp_path, "horizontal", rows, names)
    assert read_velocities(tmp_path, options).tolist() == [[1.0, 0.5]] * 5
    found = mapped_csv.load_content(tmp_path / "a.csv", options).samples
    attitude = [s.fields for s in found if s.message == "Attitude"]
    assert [a["yaw_rate_radps"] for a in attitude] == pytest.approx([0.3] * 5)
    assert [a["yaw_rad"] for a in attitude] == pytest.approx([0.006 * k for k in range(5)])


def test_velocity_frame_error_names_missing_columns(tmp_path: Path) -> None:
    rows = np.array([[0.02 * k, 0.0, 0.0, 1.0, 0.5, 0.3] for k in range(5)])
    names = ("time", "roll", "pitch", "vx", "vy", "yaw_rate")
    for frame, wanted in (
        ("body", r"a\.csv: velocity in frame body needs \[vz\], \[roll\] and \[pitch\]"),
        ("world", r"a\.csv: velocity in frame world needs \[yaw\] or \[qw\]"),
    ):
        options = write_log(tmp_path, frame, rows, names)
        with pytest.raises(SourceError, match=wanted):
            read_velocities(tmp_path, options)
