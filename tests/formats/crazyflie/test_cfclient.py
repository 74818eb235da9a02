"""CSV logs of the Crazyflie client become samples."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.crazyflie import cfclient
from dmrl.formats.registry import find_format
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import count_left_out

from ..reading import group_by_topic


@pytest.fixture
def swarm(tmp_path: Path) -> Path:
    """Write the logs of two robots with two log blocks each, named as by the client."""
    for robot in ("cf1", "cf2"):
        folder = tmp_path / robot
        folder.mkdir()
        state = [
            "Timestamp,stateEstimate.vx,stateEstimate.vy,stateEstimate.z,stateEstimate.roll,"
            "stateEstimate.pitch,stateEstimate.yaw"
        ]
        state += [
            f"{2**24 - 20 + 10 * k if k < 2 else 10 * k - 20},1.0,0.0,0.5,10,20,90"
            for k in range(10)
        ]
        (folder / "state-20221011T10-33-31.csv").write_text("\n".join(state) + "\n")
        ranges = [
            "Timestamp,gyro.z,ranging.distance2",
            *(f"{2**24 - 15 + 10 * k},57.29578,{1 + k}.5" for k in range(2)),
        ]
        (folder / "range-20221011T10-33-32.csv").write_text("\n".join(ranges) + "\n")
    return tmp_path


def read_samples(source: Path) -> dict[str, list[Sample]]:
    """Return the samples of a file or folder by topic."""
    return group_by_topic(cfclient.load_content(source, Options()).samples)


def test_a_folder_of_folders_is_a_swarm(swarm: Path) -> None:
    assert find_format(swarm).name == "cfclient"
    with count_left_out() as left:
        found = read_samples(swarm)
    assert left.counts == {"ranges of cf2 to itself": 2}
    assert {topic: len(v) for topic, v in found.items() if topic.startswith("/cf1")} == {
        "/cf1/attitude": 10,
        "/cf1/velocity": 10,
        "/cf1/height": 10,
        "/cf1/range/cf2": 2,
        "/cf1/log/state": 10,
        "/cf1/log/range": 2,
    }
    assert "/cf2/range/cf2" not in found  # a range to itself is ignored


def test_units_signs_and_the_clock_s_wrap(swarm: Path) -> None:
    found = read_samples(swarm / "cf1")
    attitude = found["/cf1/attitude"]
    assert np.diff([s.time_ns for s in attitude]).tolist() == [10_000_000] * 9
    assert attitude[0].fields == pytest.approx(
        {
            "roll_rad": np.radians(10),
            "pitch_rad": -np.radians(20),
            "yaw_rad": np.pi / 2,
            "yaw_rate_radps": 1.0,  # from the other log block
        },
        rel=1e-6,
    )
    # The robot moves along the world's x and faces along y, hence to its right.
    fields = found["/cf1/velocity"][0].fields
    assert (fields["vx_mps"], fields["vy_mps"]) == pytest.approx((0, -1), abs=1e-9)
    assert [s.fields["range_m"] for s in found["/cf1/range/cf2"]] == [1.5, 2.5]


@pytest.mark.parametrize("names", ["ab", "ba"])
def test_blocks_before_and_after_the_clock_s_wrap_are_of_one_flight(
    names: str, tmp_path: Path
) -> None:
    early, late = names
    before = [f"{2**24 - 30 + 10 * k},{k}" for k in range(3)]
    after = [f"{5 + 10 * k},{k}.5" for k in range(3)]
    (tmp_path / f"{early}.csv").write_text("\n".join(["Timestamp,gyro.z", *before]) + "\n")
    (tmp_path / f"{late}.csv").write_text("\n".join(["Timestamp,ranging.distance2", *after]) + "\n")
    found = read_samples(tmp_path)
    first = found[f"/cf1/log/{early}"][0].time_ns
    assert first == (2**24 - 30) * 1_000_000
    assert [s.time_ns - first for s in found["/cf1/range/cf2"]] == [35e6, 45e6, 55e6]


@pytest.mark.parametrize(
    ("cell", "kind"),
    [("2147483647", "i"), ("-2147483647", "i"), ("2147483648", "d"), ("+7", "i"), ("7.0", "d")],
)
def test_columns_of_32_bit_integers_stay_integers(cell: str, kind: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"Timestamp,x\n5,{cell}\n6,1\n")
    block = cfclient.read_block(tmp_path / "a.csv")
    assert block.columns["x"].dtype.char.replace("l", "i") == kind
    assert block.columns["x"].tolist() == [float(cell), 1]
    assert block.time_ns.tolist() == [5_000_000, 6_000_000]


def test_a_block_is_named_without_its_date(tmp_path: Path) -> None:
    for stem, name in (("my-log-20221011T10-33-31", "my-log"), ("log-2022", "log-2022")):
        (tmp_path / f"{stem}.csv").write_text("Timestamp,x\n5,1\n")
        assert cfclient.read_block(tmp_path / f"{stem}.csv").name == name


def test_truncated_last_line_is_omitted_and_reported(
    swarm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = swarm / "cf1" / "state-20221011T10-33-31.csv"
    path.write_text(path.read_text()[:-8])
    assert len(read_samples(path)["/cf1/attitude"]) == 9
    assert "left out: lines with fewer or more cells than the header: 1" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["Timestamp,a\n", "Timestamp,a\nnan,2\n"])
def test_files_without_a_row_are_left_out_of_several(
    text: str, swarm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in [swarm / "cf1" / "a.csv", *(swarm / "cf2").iterdir()]:
        path.write_text(text)
    with count_left_out() as left:
        found = read_samples(swarm)
    assert (left.counts["files without a row"], len(found["/cf1/attitude"])) == (3, 10)
    assert left.first["files without a row"] == str(swarm / "cf1" / "a.csv")
    assert not any(topic.startswith("/cf2") for topic in found)
    assert "/cf2" not in capsys.readouterr().err.replace(str(swarm), "")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Timestamp,a\n", "has no rows|characters|columns"),
        ("Timestamp,a\nnan,2\nx,3\n", "no number in Timestamp"),
    ],
)
def test_invalid_log_gives_one_line_error(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(SourceError, match=message):
        read_samples(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("cells", "said"),
    [
        (("1500", "0", "2500"), ""),
        (("1500.0", "0.0", "2500.0"), "only whole numbers, 1500 or more: read as millimetres"),
        (("1.5", "0.0", "2.5"), ""),
    ],
)
def test_integers_are_millimetres(
    cells: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [f"{1000 + 20 * k},{cell}" for k, cell in enumerate(cells)]
    path = tmp_path / "range-20221011T10-33-32.csv"
    path.write_text("\n".join(["Timestamp,ranging.distance2", *rows]) + "\n")
    got = read_samples(path)["/cf1/range/cf2"]
    assert [s.fields["range_m"] for s in got] == [1.5, 2.5]
    err = capsys.readouterr().err
    assert said in err and "left out" not in err


def test_implausible_millimetres_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "range-20221011T10-33-32.csv"
    path.write_text("Timestamp,ranging.distance2\n1000,2\n1020,3\n")
    read_samples(path)
    assert "3 at most. Are they metres?" in capsys.readouterr().err


def test_attitude_is_put_together_from_several_blocks(tmp_path: Path) -> None:
    """Roll, pitch and yaw may be in different blocks; yaw is interpolated across 180 degrees."""
    (tmp_path / "tilt.csv").write_text(
        "Timestamp,stateEstimate.roll,stateEstimate.pitch\n1000,10.5,20.5\n1020,10.5,20.5\n"
    )
    (tmp_path / "yaw.csv").write_text("Timestamp,stateEstimate.yaw\n990,179.5\n1010,-179.5\n")
    first = read_samples(tmp_path)["/cf1/attitude"][0].fields
    assert (first["roll_rad"], first["pitch_rad"]) == pytest.approx(np.radians((10.5, -20.5)))
    assert first["yaw_rad"] == pytest.approx(np.pi)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("Timestamp," + "a" * 200_000 + "\n1,2\n", "characters"),
        ("Timestamp," + ",".join(f"a{k}" for k in range(1001)) + "\n", "columns"),
    ],
)
def test_header_without_end_gives_one_line_error(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(SourceError, match=complaint):
        cfclient.load_content(path, Options())


def test_a_log_of_very_many_variables_is_refused(tmp_path: Path) -> None:
    """The time to build the message type grows with the square of the number of variables."""
    path = tmp_path / "log.csv"
    names = ",".join(f"a{k}" for k in range(1001))
    path.write_text(f"Timestamp,{names}\n" + f"{'1,' * 1001}1\n" * 2)
    with pytest.raises(SourceError, match="1000"):
        list(cfclient.load_content(path, Options()).samples)


@pytest.mark.parametrize(
    ("line", "whole"), [("nan,1", False), ("inf,1", False), ("5,nan", True), ("5,1,1", False)]
)
def test_lines_need_a_numeric_time_and_values_may_be_missing(
    line: str, whole: bool, tmp_path: Path
) -> None:
    (tmp_path / "a.csv").write_text(f"Timestamp,x\n{line}\n6,1\n")
    if whole:
        assert cfclient.read_block(tmp_path / "a.csv").time_ns.tolist() == [
            5_000_000,
            6_000_000,
        ]
    else:
        with count_left_out() as left_out:
            assert cfclient.read_block(tmp_path / "a.csv").time_ns.tolist() == [6_000_000]
        assert sum(left_out.counts.values()) == 1


@pytest.mark.parametrize("head", ["Timestamp,,x", "Time,x,y", "x,Timestamp,y"])
def test_a_header_is_the_time_and_names(head: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"{head}\n1,2,3\n")
    with pytest.raises(SourceError, match=r"a\.csv:1: not Timestamp and names"):
        cfclient.read_block(tmp_path / "a.csv")


def test_log_block_may_have_one_row(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Timestamp,x\n5,1\n")
    (tmp_path / "b.csv").write_text("Timestamp,y\n5,1\n7,2\n")
    found = read_samples(tmp_path)
    assert [s.time_ns for s in found["/cf1/log/a"]] == [5_000_000]
    assert [s.time_ns for s in found["/cf1/log/b"]] == [5_000_000, 7_000_000]


def test_a_block_of_two_flights_in_a_folder_is_refused_with_both_files(tmp_path: Path) -> None:
    for hour in (12, 13):
        path = tmp_path / f"state-20240301T{hour}-00-00.csv"
        path.write_text(f"Timestamp,stateEstimate.z\n{hour}000,0.5\n")
    with pytest.raises(SourceError, match=r"T12.*T13.* are the same log block of two flights"):
        read_samples(tmp_path)


def test_microseconds_since_1970_are_no_milliseconds(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Timestamp,a.b\n" + "".join(f"{17 * 10**14 + k},1\n" for k in range(3)))
    with pytest.raises(SourceError, match=r"1700000000000002 in Timestamp is after the year 2262"):
        cfclient.read_block(path)


def test_a_client_that_logged_two_flights_is_refused_with_the_line(tmp_path: Path) -> None:
    flight = [f"{10 * k},1.5" for k in range(300)]
    text = "\n".join(["Timestamp,x", *(f"{5000 + 10 * k},1.5" for k in range(300)), *flight])
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(SourceError, match=r"a\.csv:302: time goes back from 7\.99 s to 0 s"):
        cfclient.read_block(tmp_path / "a.csv")


def test_parts_of_a_millisecond_are_kept(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "Timestamp,stateEstimate.z\n16777215.75,0.5\n2.25,0.6\n10.5,0.7\n"
    )
    times = [s.time_ns for s in read_samples(tmp_path)["/cf1/height"]]
    assert np.diff(times).tolist() == [2_500_000, 8_250_000]
