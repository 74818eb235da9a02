"""Third-party CSV files read by column maps."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.files import mapped_csv
from dmrl.formats.files.column_map import QUANTITIES
from dmrl.formats.registry import find_format
from dmrl.geometry.rotations import euler_to_quaternion, quaternion_to_euler
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import count_left_out

from ..reading import group_by_topic

TABLE = """
[time]
name = "t (ms)"
unit = "ms"
[roll]
name = "phi"
unit = "deg"
[pitch]
name = "theta"
unit = "deg"
sign = -1
[yaw]
name = "psi"
unit = "rad"
[yaw_rate]
name = "r"
unit = "deg/s"
[vx]
name = "vx"
unit = "cm/s"
frame = "world"
[vy]
name = "vy"
unit = "cm/s"
frame = "world"
[height]
name = "h"
unit = "mm"
[range.cf2]
name = "d2"
unit = "mm"
"""
HEADER = "t (ms);phi;theta;psi;r;vx;vy;h;d2;note"
ROWS = ("1000;10;20;1.5707963;5;100;0;500;1500;ok", "1010.5;10;20;1.5707963;5;100;0;510;;ok")


def read_samples(source: Path, options: Options | None = None) -> dict[str, list[Sample]]:
    """Return the samples of a CSV file by topic."""
    return group_by_topic(mapped_csv.load_content(source, options or Options()).samples)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Return a column map; the log that it describes is beside it."""
    (tmp_path / "log.csv").write_text("\n".join([HEADER, *ROWS]) + "\n")
    (tmp_path / "map.toml").write_text(TABLE)
    return tmp_path / "map.toml"


def test_units_frames_and_signs_follow_the_column_map(table: Path) -> None:
    found = read_samples(table.with_name("log.csv"), Options(columns=table))
    attitude = found["/cf1/attitude"][0].fields
    assert (attitude["roll_rad"], attitude["pitch_rad"]) == pytest.approx(np.radians((10, -20)))
    assert (attitude["yaw_rad"], attitude["yaw_rate_radps"]) == pytest.approx(
        (np.pi / 2, np.radians(5)), abs=1e-6
    )
    # The robot moves along the world's x and faces along y, hence to its right.
    velocity = found["/cf1/velocity"][0].fields
    assert (velocity["vx_mps"], velocity["vy_mps"]) == pytest.approx((0, -1), abs=1e-6)
    assert found["/cf1/height"][1].fields == {"height_m": pytest.approx(0.51)}
    assert [(s.time_ns, s.fields["range_m"]) for s in found["/cf1/range/cf2"]] == [(10**9, 1.5)]
    assert found["/cf1/height"][1].time_ns == 1_010_500_000
    logged = found["/cf1/log/columns"][1].fields
    assert logged["t__ms_"] == 1010.5 and np.isnan(logged["d2"]) and "note" not in logged


@pytest.mark.parametrize("frame", ["horizontal", "body"])
def test_velocities_of_other_frames_are_turned(frame: str, table: Path) -> None:
    third = '[vz]\nname = "h"\nunit = "mm/s"\nframe = "body"\n' if frame == "body" else ""
    table.write_text(TABLE.replace('frame = "world"', f'frame = "{frame}"') + third)
    found = read_samples(table.with_name("log.csv"), Options(columns=table))
    fields = found["/cf1/velocity"][0].fields
    if frame == "horizontal":
        assert (fields["vx_mps"], fields["vy_mps"]) == pytest.approx((1, 0), abs=1e-9)
        return
    (cr, cp), (sr, sp) = np.cos(np.radians((10, -20))), np.sin(np.radians((10, -20)))
    level = [cp + sp * cr * 0.5, -sr * 0.5, -sp + cp * cr * 0.5]
    assert [fields[f"v{axis}_mps"] for axis in "xyz"] == pytest.approx(level)


@pytest.mark.parametrize(
    ("line", "reason", "heights"),
    [
        ("soon;1;2;3;4;5;6;7;8;x", "rows without a time", 3),
        ("-5;1;2;3;4;5;6;7;8;x", "rows with times before 0", 3),
        ("1020;much;2;3;4;5;6;7;8;x", "cells of 'phi' that are no number", 4),
        ("1020;1;2;3", "lines with fewer or more cells than the header", 3),
        ("1020;inf;2;3;4;5;6;7;8;x", "infinite values of roll", 4),
    ],
)
def test_a_line_that_cannot_be_used_is_left_out_and_named(
    line: str, reason: str, heights: int, table: Path
) -> None:
    log = table.with_name("log.csv")
    log.write_text(log.read_text() + line + "\n1030;1;2;3;4;5;6;7;8;x\n")
    with count_left_out() as left_out:
        found = read_samples(log, Options(columns=table))
    ((told, count),) = left_out.counts.items()
    assert told.startswith(reason) and count == 1
    assert str(log) in left_out.first[told]
    assert left_out.first[told].endswith(":4") != (reason == "infinite values of roll")
    assert len(found["/cf1/height"]) == heights
    assert len(found["/cf1/attitude"]) == 3


def test_a_file_without_any_time_is_refused(table: Path) -> None:
    log = table.with_name("log.csv")
    log.write_text(log.read_text().replace("1000;", "a;").replace("1010.5;", "b;"))
    with pytest.raises(SourceError, match=r"log\.csv:2: 'a' in t \(ms\) is no time"):
        read_samples(log, Options(columns=table))


def test_a_column_that_is_not_there_is_named(table: Path) -> None:
    table.write_text(TABLE.replace('"phi"', '"roll"'))
    with pytest.raises(SourceError, match=r"log\.csv: no column roll\. Fix the table"):
        read_samples(table.with_name("log.csv"), Options(columns=table))


def test_impossible_ranges_are_counted_and_empty_cells_are_not(
    table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = table.with_name("log.csv")
    rows = [
        f"{1020 + 10 * k};0;0;0;0;0;0;500;{range_mm};x" for k, range_mm in enumerate(["0", "9", ""])
    ]
    log.write_text(log.read_text() + "\n".join([*rows, "1050;0;0;0;0;0;0;500;70000;x"]) + "\n")
    found = read_samples(log, Options(columns=table))["/cf1/range/cf2"]
    assert [s.fields["range_m"] for s in found] == pytest.approx([1.5, 0.009])
    assert "0 and under 60 m: 2" in capsys.readouterr().err


def test_implausible_units_are_reported(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = table.with_name("log.csv")
    rows = [f"{1000 + 10 * k};0;0;{0.02 * k};114.6;0;0;0;0;x" for k in range(50)]  # 2 rad/s
    log.write_text("\n".join([HEADER, *rows]) + "\n")
    table.write_text(TABLE.replace('unit = "deg/s"', 'unit = "rad/s"'))
    read_samples(log, Options(columns=table))
    assert "turning rates are 57 times the slope of yaw. Are they deg/s?" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name",
    [
        "B8_star_fast_rep2",
        pytest.param("B7_oval_medium_rep3", marks=pytest.mark.slow),
        pytest.param("B9_trefoil_fast_rep4", marks=pytest.mark.slow),
    ],
)
def test_flights_of_nanobench_are_known_and_agree_with_vicon(
    name: str, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = data / "nanobench" / f"{name}.csv"
    assert find_format(source).name == "columns"
    found = read_samples(source)
    assert capsys.readouterr().err == ""
    with source.open() as stream:
        first = stream.readlines()[1].split(",")[0]
    assert found["/cf1/attitude"][0].time_ns == int(first.replace(".", ""))

    def read_rows(topic: str, *names: str) -> np.ndarray:
        return np.array([[s.fields[n] for n in names] for s in found[topic]])

    truth = [s.fields["pose"] for s in found["/cf1/pose/truth"]]
    turned = np.array([[p["orientation"][axis] for axis in "xyzw"] for p in truth])
    place = np.array([[p["position"][axis] for axis in "xyz"] for p in truth])
    angles = read_rows("/cf1/attitude", "roll_rad", "pitch_rad", "yaw_rad")
    off = angles - quaternion_to_euler(turned)
    off[:, 2] = (off[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert (np.median(np.abs(off), axis=0) < 0.06).all()
    time_s = np.array([s.time_ns for s in found["/cf1/velocity"]]) * 1e-9
    vx, vy = read_rows("/cf1/velocity", "vx_mps", "vy_mps").T
    c, s = np.cos(angles[:, 2]), np.sin(angles[:, 2])
    world = np.stack([c * vx - s * vy, s * vx + c * vy], axis=1)
    true = np.gradient(place[:, :2], time_s - time_s[0], axis=0)
    # The estimate lags, so that its error is a tenth of the speed in the fast flights.
    assert np.median(np.linalg.norm(world - true, axis=1)) < 0.12
    assert min(np.corrcoef(world[:, k], true[:, k])[0, 1] for k in (0, 1)) > 0.97
    assert np.ptp(place[:, 0]) > 1


def write_turn(table: Path, told: float, slope: float, count: int = 50) -> None:
    """Write and read a log at 100 Hz with a gyroscope's rate, deg/s, and a yaw slope, rad/s."""
    rows = [f"{1000 + 10 * k};0;0;{slope * k / 100};{told};0;0;0;0;x" for k in range(count)]
    table.with_name("log.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    read_samples(table.with_name("log.csv"), Options(columns=table))


@pytest.mark.parametrize(
    ("told", "slope", "said"),
    [
        (9.9, 1.0, ""),
        (10.1, 1.0, "turning rates are 10 times the slope of yaw. Are they deg/s?"),
        (0.49, 0.01, ""),  # too slow a turn to tell
        (0.51, 0.01, "turning rates are 51 times"),
        (1.0, 9.9, ""),
        (1.0, 10.1, "turning rates are 1/10 of the slope of yaw. Are they rad/s?"),
        (0.01, 0.49, ""),
        (0.01, 0.51, "turning rates are 1/51"),
    ],
)
def test_turning_rates_of_a_wrong_unit_are_reported(
    told: float, slope: float, said: str, table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_turn(table, np.degrees(told), slope)
    err = capsys.readouterr().err
    assert said in err and bool(said) == ("turning rates" in err)
    write_turn(table, np.degrees(told), slope, 2)
    assert "turning rates" not in capsys.readouterr().err


def test_lines_out_of_order_are_sorted_and_the_last_may_be_cut(
    table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = table.with_name("log.csv")
    log.write_text("\n".join([HEADER, ROWS[1], ROWS[0], "1020;1;2"]))
    found = read_samples(log, Options(columns=table))["/cf1/height"]
    assert [s.time_ns for s in found] == [1_000_000_000, 1_010_500_000]
    assert [s.fields["height_m"] for s in found] == [0.5, 0.51]
    err = capsys.readouterr().err
    assert "log.csv:3: rows are not in time order from here on; sorted" in err
    assert "cells than the header: 1" in err


@pytest.mark.parametrize(
    ("cell", "time_ns"),
    [("0", 0), ("9223372036854.775807", 2**63 - 1), ("9223372036854.775808", None)],
)
def test_times_are_whole_nanoseconds_of_63_bits(
    cell: str, time_ns: int | None, table: Path
) -> None:
    log = table.with_name("log.csv")
    log.write_text(f"{HEADER}\n{ROWS[0].replace('1000', cell, 1)}\n")
    if time_ns is None:
        with pytest.raises(SourceError, match="is no time from 1970 to 2262"):
            read_samples(log, Options(columns=table))
    else:
        assert read_samples(log, Options(columns=table))["/cf1/height"][0].time_ns == time_ns


def test_each_file_of_a_folder_is_a_robot_with_its_name(table: Path) -> None:
    folder = table.with_name("logs")
    folder.mkdir()
    for name in ("a.csv", "b.CSV"):
        (folder / name).write_text(table.with_name("log.csv").read_text())
    (folder / "notes.txt").write_text("x")
    (folder / "notes.csv").write_text("by,whom\nme,1\n")
    found = read_samples(folder, Options(columns=table, names={"a": "left"}))
    assert {topic.split("/")[1] for topic in found} - {"tf"} == {"left", "b"}


def test_repeated_column_is_refused(table: Path) -> None:
    log = table.with_name("log.csv")
    log.write_text(log.read_text().replace(";note", ";vx"))
    with pytest.raises(SourceError, match="a column appears twice"):
        read_samples(log, Options(columns=table))


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_most_frequent_delimiter_is_used(separator: str, table: Path) -> None:
    log = table.with_name("log.csv")
    other = "," if separator != "," else ";"
    text = log.read_text().replace(";", separator).replace("note", f'"a{other}b"')
    log.write_text("\ufeff" + text, encoding="utf-8")
    assert len(read_samples(log, Options(columns=table))["/cf1/height"]) == 2


def test_every_quantity_of_the_column_map_reaches_its_topic(tmp_path: Path) -> None:
    """Every column has another number, so that no two can be exchanged unnoticed."""
    frames = {f"v{axis}": 'frame = "world"\n' for axis in "xyz"}
    first = {"rad": "rad", "rad/s": "rad/s", "m": "m", "m/s": "m/s", "1": "1", "s": "s"}
    names = [n for n in QUANTITIES if n != "height"]
    text = "".join(
        f'[{n}]\nname = "{n}"\nunit = "{first[next(iter(QUANTITIES[n]))]}"\n{frames.get(n, "")}'
        for n in names
    )
    (tmp_path / "map.toml").write_text(text)
    row = dict(zip(names, (np.arange(len(names)) + 1) / 64, strict=True)) | {"time": 2.0}
    (quaternion,) = euler_to_quaternion(np.array([[0.4, -0.3, 1.2]]))
    row |= dict(zip(("qx", "qy", "qz", "qw"), quaternion.tolist(), strict=True))
    row |= {"true_qx": 0.0, "true_qy": 0.6, "true_qz": 0.0, "true_qw": 0.8}
    (tmp_path / "log.csv").write_text(f"{','.join(row)}\n{','.join(map(str, row.values()))}\n")
    found = read_samples(tmp_path / "log.csv", Options(columns=tmp_path / "map.toml"))
    assert {s.time_ns for v in found.values() for s in v} == {2 * 10**9}
    yaw, rate = 1.2, row["gyro_y"] * np.sin(0.4) + row["gyro_z"] * np.cos(0.4)
    attitude = found["/cf1/attitude"][0].fields  # from the quaternion and two axes of the gyroscope
    wanted = {"roll_rad": 0.4, "pitch_rad": -0.3, "yaw_rad": yaw}
    assert attitude == pytest.approx({**wanted, "yaw_rate_radps": rate / np.cos(0.3)})
    c, s = np.cos(yaw), np.sin(yaw)
    velocity = found["/cf1/velocity"][0].fields
    assert velocity == pytest.approx(
        {
            "vx_mps": c * row["vx"] + s * row["vy"],
            "vy_mps": c * row["vy"] - s * row["vx"],
            "vz_mps": row["vz"],
        }
    )
    assert found["/cf1/height"][0].fields == pytest.approx({"height_m": row["z"]})
    for topic, before in (("/cf1/pose", ""), ("/cf1/pose/truth", "true_")):
        pose = found[topic][0].fields["pose"]
        assert pose["position"] == pytest.approx({n: row[f"{before}{n}"] for n in "xyz"})
        assert pose["orientation"] == pytest.approx({n: row[f"{before}q{n}"] for n in "xyzw"})


def test_ranges_to_any_peer_need_the_peer_in_the_name(table: Path) -> None:
    table.write_text(TABLE.replace("[range.cf2]", '[range."*"]'))
    with pytest.raises(SourceError, match=r"\[range\.\*\] name: no \{peer\} in it"):
        read_samples(table.with_name("log.csv"), Options(columns=table))


def test_a_table_of_unknown_columns_names_the_flag_that_states_them(table: Path) -> None:
    for source in (table.parent, table.with_name("log.csv")):
        with pytest.raises(SourceError, match=r"--columns map\.toml"):
            find_format(source)


def test_columns_without_a_value_are_named(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [row.replace(";500;", ";NaN;").replace(";510;", ";-;") for row in ROWS]
    table.with_name("log.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    assert "/cf1/height" not in read_samples(table.with_name("log.csv"), Options(columns=table))
    err = capsys.readouterr().err
    assert "log.csv: no row has a value in h, so there is no height\n" in err
    assert "log.csv: no height, which dmrl label needs" in err


def test_rows_without_a_robot_are_left_out(table: Path) -> None:
    rows = [f"{row};{robot}" for row, robot in zip(ROWS, ("cf1", ""), strict=True)]
    table.with_name("log.csv").write_text("\n".join([f"{HEADER};id", *rows]) + "\n")
    table.write_text(f'{TABLE}[robot]\nname = "id"\n')
    with count_left_out() as left:
        found = read_samples(table.with_name("log.csv"), Options(columns=table))
    assert left.counts == {"rows without a robot": 1} and len(found["/cf1/height"]) == 1
