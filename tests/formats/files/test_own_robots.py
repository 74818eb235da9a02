"""One column map reads several robots: in a file each, in columns each, or in rows each."""

import math
from pathlib import Path

import numpy as np
import pytest

import dmrl
from dmrl.errors import SettingError, SourceError
from dmrl.formats.base import Options
from dmrl.formats.files import mapped_csv
from dmrl.recording import read_table

pytestmark = pytest.mark.heavy

QUANTITIES = {
    "time": "s",
    "roll": "rad",
    "pitch": "rad",
    "yaw_rate": "rad/s",
    "vx": "m/s",
    "vy": "m/s",
    "height": "m",
}


def format_map(form: str = "{}", more: str = "", peer: str = "range_{peer}") -> str:
    """Return a column map; ``form`` makes the name of a column from that of its quantity."""
    text = more
    for name, unit in QUANTITIES.items():
        column = name if name == "time" else form.format(name)
        text += f'[{name}]\nname = "{column}"\nunit = "{unit}"\n'
        text += 'frame = "horizontal"\n' if name[0] == "v" else ""
    return text + f'[range."*"]\nname = "{form.format(peer)}"\nunit = "m"\n'


def read_documented_map() -> str:
    """Return the column map of docs/own_robot.md."""
    page = Path(__file__).parents[3] / "docs" / "own_robot.md"
    return page.read_text(encoding="utf-8").partition("```toml\n")[2].partition("```")[0]


def simulate_drive(rate_hz: float = 50.0) -> tuple[np.ndarray, dict[str, dict[str, np.ndarray]]]:
    """Return times, s, and the noisy measurements of a rover and a boat that drive for a minute."""
    rng = np.random.default_rng(3)
    time_s = np.arange(0.0, 60.0, 1 / rate_hz)
    paths = {
        "rover": np.stack([1.5 * np.sin(0.3 * time_s), np.sin(0.45 * time_s)]),
        "boat": np.stack([3.0 + np.cos(0.35 * time_s), 1.2 * np.sin(0.25 * time_s)]),
    }
    level = np.zeros(len(time_s))
    logs = {}
    for own, peer in (("rover", "boat"), ("boat", "rover")):
        moving = np.gradient(paths[own], time_s, axis=1)
        yaw = np.unwrap(np.arctan2(moving[1], moving[0]))
        logs[own] = {
            "roll": level,
            "pitch": level,
            "yaw_rate": np.gradient(yaw, time_s),
            "vx": np.hypot(*moving) + rng.normal(0, 0.03, len(time_s)),
            "vy": level,
            "height": level + 0.2,
            f"range_{peer}": np.hypot(*(paths[own] - paths[peer]))
            + rng.normal(0, 0.05, len(time_s)),
        }
    return time_s, logs


def format_table(columns: dict[str, np.ndarray]) -> list[str]:
    """Return the lines of a CSV table with a header."""
    rows = np.column_stack(list(columns.values()))
    return [",".join(columns), *(",".join(f"{x:.9g}" for x in row) for row in rows)]


def write_drive(folder: Path, layout: str) -> Path:
    """Write the drive in one of three layouts, and its column map; return the source."""
    time_s, logs = simulate_drive()
    if layout == "a file per robot":
        (folder / "logs").mkdir()
        for own, log in logs.items():
            (folder / "logs" / f"{own}.csv").write_text(
                "\n".join(format_table({"time": time_s} | log))
            )
        (folder / "map.toml").write_text(read_documented_map())
        return folder / "logs"
    if layout == "columns per robot":
        wide = {f"{own}_{name}": x for own, log in logs.items() for name, x in log.items()}
        (folder / "all.csv").write_text("\n".join(format_table({"time": time_s} | wide)))
        (folder / "map.toml").write_text(format_map("{{robot}}_{}"))
        return folder / "all.csv"
    rows = []
    for own, log in logs.items():
        padded = {"time": time_s} | log
        padded = {n: padded.get(n, np.full(len(time_s), np.nan)) for n in ALL_COLUMNS}
        head, *mine = format_table(padded)
        rows += [f"{line},{own}" for line in mine]
    (folder / "all.csv").write_text("\n".join([f"{head},who", *rows]))
    (folder / "map.toml").write_text(format_map(more='[robot]\nname = "who"\n'))
    return folder / "all.csv"


ALL_COLUMNS = (*QUANTITIES, "range_boat", "range_rover")
LAYOUTS = ("a file per robot", "columns per robot", "rows per robot")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_one_column_map_serves_all_robots(layout: str, tmp_path: Path) -> None:
    source = write_drive(tmp_path, layout)
    out = dmrl.convert(source, tmp_path / "out.mcap", columns=tmp_path / "map.toml").path
    time_s, logs = simulate_drive()
    for own, peer in (("rover", "boat"), ("boat", "rover")):
        wanted = {
            f"/{own}/attitude": {n: f"{n}_rad" for n in ("roll", "pitch")}
            | {"yaw_rate": "yaw_rate_radps"},
            f"/{own}/velocity": {"vx": "vx_mps", "vy": "vy_mps"},
            f"/{own}/height": {"height": "height_m"},
            f"/{own}/range/{peer}": {f"range_{peer}": "range_m"},
        }
        for topic, fields in wanted.items():
            found = read_table(out, topic)
            np.testing.assert_allclose(found["log_time"].to_numpy() * 1e-9, time_s, atol=1e-9)
            for name, field in fields.items():
                np.testing.assert_allclose(found[field].to_numpy(), logs[own][name], atol=1e-7)


def test_own_sensors_are_labelled_both_ways(tmp_path: Path) -> None:
    source = write_drive(tmp_path, "a file per robot")
    recording = dmrl.convert(source, tmp_path / "out.mcap", columns=tmp_path / "map.toml")
    labelled = dmrl.label(recording.path, tmp_path / "labelled.mcap")
    for own, peer in (("rover", "boat"), ("boat", "rover")):
        position = labelled[f"/{own}/peer/{peer}/position"].to_pandas()
        assert (position["status"] == "OK").mean() > 0.25


def test_robots_may_have_different_sensors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_drive(tmp_path, "a file per robot")
    boat = source / "boat.csv"
    rows = [line.split(",") for line in boat.read_text().splitlines()]
    at = rows[0].index("height")
    boat.write_text("\n".join(",".join(r[:at] + r[at + 1 :]) for r in rows))
    options = Options(columns=tmp_path / "map.toml")
    found = {s.topic for s in mapped_csv.load_content(source, options).samples}
    assert "/rover/height" in found and "/boat/height" not in found
    err = capsys.readouterr().err
    assert "boat.csv: no column height, which other robots have" in err
    assert "boat.csv: no height, which dmrl label needs" in err
    with pytest.raises(
        SourceError,
        match=r"boat\.csv: no column height\. Fix the table of columns; the file has \w+",
    ):
        mapped_csv.load_content(boat, options)
    text = (tmp_path / "map.toml").read_text().replace('name = "height"', "value = 0.2")
    (tmp_path / "map.toml").write_text(text)
    heights = [
        s.fields["height_m"]
        for s in mapped_csv.load_content(boat, options).samples
        if s.message == "Height"
    ]
    assert heights == [0.2] * 3000


def test_robots_and_peers_are_renamed(tmp_path: Path) -> None:
    source = write_drive(tmp_path, "columns per robot")
    options = Options(columns=tmp_path / "map.toml", names={"rover": "a", "boat": "b"})
    found = {s.topic for s in mapped_csv.load_content(source, options).samples}
    assert {"/a/range/b", "/b/range/a", "/a/velocity"} < found
    with pytest.raises(SettingError, match=r"--robot has no effect: .* names its robots"):
        mapped_csv.load_content(source, Options(columns=tmp_path / "map.toml", robot="c"))


def test_robot_without_roll_and_pitch_is_level(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "map.toml").write_text(
        '[time]\nname = "t"\nunit = "s"\n[yaw_rate]\nname = "w"\nunit = "deg/s"\n'
        '[vx]\nname = "v"\nunit = "m/s"\nframe = "horizontal"\n'
        '[vy]\nvalue = 0\nunit = "m/s"\nframe = "horizontal"\n'
        '[height]\nvalue = 15\nunit = "cm"\n'
    )
    rows = [f"{0.1 * k:.1f} 90 0.5" for k in range(20)]
    (tmp_path / "log.txt").write_text("\n".join(["t w v", *rows]))
    options = Options(columns=tmp_path / "map.toml")
    found = list(mapped_csv.load_content(tmp_path / "log.txt", options).samples)
    attitude = [s.fields for s in found if s.message == "Attitude"]
    assert attitude[10] == pytest.approx(
        {"roll_rad": 0, "pitch_rad": 0, "yaw_rad": math.pi / 2, "yaw_rate_radps": math.pi / 2}
    )
    assert {s.fields["height_m"] for s in found if s.message == "Height"} == {0.15}
    velocity = next(s.fields for s in found if s.message == "Velocity")
    assert velocity == {"vx_mps": 0.5, "vy_mps": 0.0}
    assert "no roll and pitch in the table: the robot is taken as level" in capsys.readouterr().err
