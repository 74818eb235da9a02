"""Flights in dmrl's own CSV columns become samples."""

from pathlib import Path

import numpy as np
import pytest

import dmrl
from dmrl import topics
from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.files import flight_csv
from dmrl.geometry.frames import AIDECK
from dmrl.images.codec import encode_png
from dmrl.samples.flight import LOG_COLUMNS, log_from_poses
from dmrl.terminal.left_out import count_left_out

HEADER = ["time_s", *LOG_COLUMNS]
Rows = list[list[object]]


def make_rows(start_s: float = 1.0, count: int = 20) -> Rows:
    """Return rows of a level flight forward at 100 Hz."""
    return [[round(start_s + 0.01 * k, 3), 0.0, 0.01, 0.1, 0.5, 0.0, 1.0] for k in range(count)]


def write_log(folder: Path, robot: str, data: Rows, header: list[str] = HEADER) -> None:
    """Write the log of a robot to a folder."""
    folder.mkdir(exist_ok=True)
    lines = [",".join(map(str, row)) for row in [header, *data]]
    (folder / f"{robot}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Return a flight of two robots; cf1 has ranges to cf2 and the true position of cf2."""
    folder = tmp_path / "flight"
    extra = ["range_cf2_m", "cf2_x_m", "cf2_y_m", "cf2_z_m"]
    mine: Rows = [
        [*row, 2.5 if k % 2 else "", *(1, 2, 0.1)] if k < 10 else [*row, "", "", "", ""]
        for k, row in enumerate(make_rows())
    ]
    write_log(folder, "cf1", mine, [*HEADER, *extra])
    write_log(folder, "cf2", make_rows())
    return folder


def test_a_flight_becomes_samples_in_time_order(flight: Path) -> None:
    assert flight_csv.can_read(flight)
    samples = list(flight_csv.load_content(flight).samples)
    times = [s.time_ns for s in samples]
    assert times == sorted(times)
    assert times[0] == 1_000_000_000
    by_topic = {
        topic: [s for s in samples if s.topic == topic] for topic in {s.topic for s in samples}
    }
    assert {topic: len(found) for topic, found in by_topic.items()} == {
        "/cf1/attitude": 20,
        "/cf1/velocity": 20,
        "/cf1/height": 20,
        "/cf1/range/cf2": 5,
        "/cf1/peer/cf2/truth": 10,
        "/cf2/attitude": 20,
        "/cf2/velocity": 20,
        "/cf2/height": 20,
    }
    assert by_topic["/cf1/velocity"][3].fields == {"vx_mps": 0.5, "vy_mps": 0.0}
    assert by_topic["/cf1/range/cf2"][0].time_ns == 1_010_000_000
    last = by_topic["/cf1/attitude"][-1].fields
    assert last["yaw_rad"] == pytest.approx(0.019)
    assert (last["pitch_rad"], last["yaw_rate_radps"]) == (0.01, 0.1)
    where = by_topic["/cf1/peer/cf2/truth"][0].fields
    assert (where["x"], where["y"], where["z"], where["frame_id"]) == (1, 2, 0.1, "cf1/horizontal")


def test_pictures_beside_the_log_come_along(flight: Path) -> None:
    (flight / "cf1").mkdir()
    picture = encode_png(np.zeros((8, 8, 3), np.uint8))
    (flight / "cf1" / "001005000000.png").write_bytes(picture)
    images = [s for s in flight_csv.load_content(flight).samples if s.topic == "/cf1/camera/image"]
    assert [(s.time_ns, s.fields["data"]) for s in images] == [(1_005_000_000, picture)]


def test_robots_get_the_given_names(flight: Path) -> None:
    folder = flight / "cf1"
    folder.mkdir()
    (folder / "0000001050000000.png").write_bytes(encode_png(np.zeros((224, 320, 3), np.uint8)))
    options = Options(names={"cf1": "left", "cf2": "right"}, camera=AIDECK)
    found = {sample.topic for sample in flight_csv.load_content(flight, options).samples}
    own = {"/left/range/right", "/left/peer/right/truth", "/left/camera/calibration"}
    assert own | {"/left/camera/image", "/right/height"} < found
    assert not [topic for topic in found if "cf" in topic]


def test_pictures_that_are_not_named_by_time_are_refused(flight: Path) -> None:
    (flight / "cf1").mkdir()
    (flight / "cf1" / "7.png").write_bytes(encode_png(np.zeros((8, 8, 3), np.uint8)))
    with pytest.raises(SourceError, match=r"7\.png is not named by its time"):
        flight_csv.load_content(flight)


def catch_error(folder: Path) -> str:
    """Return the one-line error of reading a flight."""
    with pytest.raises(SourceError) as caught:
        list(flight_csv.load_content(folder).samples)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_second_flight_is_refused_with_its_line(flight: Path) -> None:
    write_log(flight, "cf2", [*make_rows(count=400), *make_rows(count=400)])
    assert "cf2.csv:402: time goes back from 4.99 s to 1 s: a second flight" in catch_error(flight)


def test_rows_that_cannot_be_used_are_left_out_with_their_line(flight: Path) -> None:
    for cell in ("nan", "", "inf", "fast"):
        data = make_rows()
        data[6][5] = cell
        write_log(flight, "cf2", [*data, [2.0, 1]])
        with count_left_out() as left_out:
            found = [s for s in flight_csv.load_content(flight).samples if s.topic == "/cf2/height"]
        assert len(found) == 19
        wanted = {
            "lines with fewer or more cells than the header": "cf2.csv:22",
            "rows without a number for vy_mps or another": "cf2.csv:8",
        } | ({"cells of 'vy_mps' that are no number": "cf2.csv:8"} if cell == "fast" else {})
        assert set(left_out.counts) == set(wanted) and set(left_out.counts.values()) == {1}
        assert all(left_out.first[r].endswith(place) for r, place in wanted.items())


def test_ranges_may_have_rows_of_their_own(flight: Path) -> None:
    data = make_rows()
    alone = [[row[0] + 0.02, *[""] * (len(HEADER) - 1), 1.5] for row in data]
    mixed = sorted([[*row, ""] for row in data] + alone, key=lambda row: row[0])
    write_log(flight, "cf2", mixed, [*HEADER, "range_cf1_m"])
    with count_left_out() as left_out:
        found = [s.topic for s in flight_csv.load_content(flight).samples]
    assert not left_out.counts
    assert found.count("/cf2/range/cf1") == found.count("/cf2/attitude") == len(data)


def test_a_missing_column_is_named(flight: Path) -> None:
    write_log(flight, "cf2", [row[:-2] for row in make_rows()], HEADER[:-2])
    assert "cf2.csv has no column vy_mps, height_m" in catch_error(flight)


def test_columns_of_no_known_name_are_counted(flight: Path) -> None:
    names = ["range_cf2", "yaw_rad", "range_cf3_m", "cf2_x_m", "note"]
    write_log(
        flight, "cf1", [[*row, 2.5, 0, 1.5, 1, "so"] for row in make_rows()], [*HEADER, *names]
    )
    with count_left_out() as left:
        list(flight_csv.load_content(flight).samples)
    assert left.counts == {"columns of no known name": 3}
    assert left.first["columns of no known name"].endswith("cf1.csv: range_cf2")


def test_incomplete_flight_is_refused(flight: Path, tmp_path: Path) -> None:
    write_log(flight, "cf2", make_rows()[:1])
    assert "fewer than two rows" in catch_error(flight)
    assert "no <robot>.csv in" in catch_error(tmp_path)
    write_log(flight, "cf2", make_rows(-0.5))
    assert "cf2.csv:2: '-0.5' in time_s is no time from 1970 to 2262" in catch_error(flight)


def test_clocks_an_hour_apart_are_refused(flight: Path) -> None:
    write_log(flight, "cf2", make_rows(3601.0))
    assert "share no time: 3600 s lie between them. Put both on one clock" in catch_error(flight)


def read_warnings(folder: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Read a flight; return the lines of its warnings."""
    list(flight_csv.load_content(folder).samples)
    return capsys.readouterr().err.splitlines()


@pytest.mark.heavy
def test_degrees_give_a_warning(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for degrees, said in (
        (0.8, ""),
        (-8.0, "values are over 0.8 rad. Are they degrees?"),
    ):
        data = make_rows(count=200)
        for row in data[::5]:
            row[1] = degrees
        write_log(flight, "cf2", data)
        dmrl.convert(flight, tmp_path / f"{degrees}.mcap")
        assert said in (err := capsys.readouterr().err) and bool(said) == ("roll_rad" in err)


def test_times_beyond_2262_are_refused(flight: Path) -> None:
    data = make_rows()
    for row in data:
        row[0] *= 1e12
    write_log(flight, "cf2", data)
    assert "nor are all others. Check the column and its unit" in catch_error(flight)


def test_gaps_give_a_warning(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(flight, "cf2", make_rows() + make_rows(4.0))
    (line,) = read_warnings(flight, capsys)
    assert line.endswith("cf2.csv: 1 gaps, the first of 2.8 s after 1.190 s")


@pytest.mark.parametrize("value", [0.0, -1.0, 65.535, 65535.0])
def test_impossible_ranges_are_left_out(
    flight: Path, value: float, capsys: pytest.CaptureFixture[str]
) -> None:
    data: Rows = [[*row, value if k == 3 else 1.5] for k, row in enumerate(make_rows())]
    write_log(flight, "cf1", data, [*HEADER, "range_cf2_m"])
    samples = [s for s in flight_csv.load_content(flight).samples if s.topic == "/cf1/range/cf2"]
    assert [s.fields["range_m"] for s in samples] == [1.5] * 19
    (line,) = capsys.readouterr().err.splitlines()
    assert "left out: ranges to cf2 that are not over 0 and under 60 m: 1" in line


def test_a_robot_without_its_file_gives_a_warning(
    flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (flight / "cf2.csv").unlink()
    (line,) = read_warnings(flight, capsys)
    assert line.endswith("has ranges to cf2, but there is no cf2.csv beside it")


def test_other_folders_are_not_taken_for_flights(tmp_path: Path) -> None:
    (tmp_path / "labels.csv").write_text("file,peer\n")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    assert not flight_csv.can_read(tmp_path)


def test_odometry_from_poses_turns_with_the_robot() -> None:
    time_s = np.arange(0, 20, 0.01)
    yaw = 0.5 * time_s
    xy = np.stack([2 * np.sin(yaw), -2 * np.cos(yaw)], axis=1)  # a circle, driven forward
    log = log_from_poses(time_s, xy, np.angle(np.exp(1j * yaw)))
    assert np.allclose(log["vx_mps"][5:-5], 1.0, atol=1e-4)
    assert np.allclose(log["vy_mps"][5:-5], 0.0, atol=1e-4)
    assert np.allclose(log["yaw_rate_radps"], 0.5)


def test_logs_that_share_their_last_samples_are_taken(flight: Path) -> None:
    write_log(flight, "cf2", make_rows(1.18))
    assert list(flight_csv.load_content(flight).samples)


def test_steps_of_a_second_are_no_gap_and_longer_ones_are(
    flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(flight, "cf2", [*make_rows(), *make_rows(2.19)])
    assert read_warnings(flight, capsys) == []
    write_log(flight, "cf2", [*make_rows(), *make_rows(2.21), *make_rows(4.0)])
    (line,) = read_warnings(flight, capsys)
    assert line.endswith("cf2.csv: 2 gaps, the first of 1.0 s after 1.190 s")


def test_clocks_must_overlap_in_any_file_order(flight: Path) -> None:
    for robot in ("cf0", "cf2"):  # read before and after cf1
        write_log(flight, robot, make_rows(1.20))
        assert "share no time: 0 s lie between them" in catch_error(flight)
        write_log(flight, robot, make_rows(1.19))
        assert list(flight_csv.load_content(flight).samples)


def test_ranges_of_60_m_or_more_are_dropped(flight: Path) -> None:
    data: Rows = [[*row, 59.99 if k % 2 else 60.0] for k, row in enumerate(make_rows())]
    write_log(flight, "cf1", data, [*HEADER, "range_cf2_m"])
    samples = [s for s in flight_csv.load_content(flight).samples if s.topic == "/cf1/range/cf2"]
    assert [s.fields["range_m"] for s in samples] == [59.99] * 10


def test_true_peer_position_needs_three_coordinates(flight: Path) -> None:
    cells = [["1", "2", ""], ["", "2", "3"], ["1", "2", "3"]]
    data: Rows = [[*row, *cells[k % 3]] for k, row in enumerate(make_rows())]
    write_log(flight, "cf1", data, [*HEADER, "cf2_x_m", "cf2_y_m", "cf2_z_m"])
    found = [s for s in flight_csv.load_content(flight).samples if s.topic.endswith("truth")]
    assert [s.time_ns for s in found] == [1_000_000_000 + 10_000_000 * k for k in range(2, 20, 3)]
    write_log(flight, "cf1", [row[:-1] for row in data], [*HEADER, "cf2_x_m", "cf2_y_m"])
    assert not [s for s in flight_csv.load_content(flight).samples if s.topic.endswith("truth")]


def test_times_beyond_63_bits_are_left_out(flight: Path) -> None:
    for robot in ("cf1", "cf2"):
        write_log(flight, robot, [[9223372018 + k, *row[1:]] for k, row in enumerate(make_rows())])
    with count_left_out() as left_out:
        found = [s for s in flight_csv.load_content(flight).samples if s.topic == "/cf2/height"]
    assert len(found) == 19 and found[-1].time_ns == 9223372036 * 10**9
    assert set(left_out.counts.values()) == {2}


def test_two_rows_are_a_flight(flight: Path) -> None:
    write_log(flight, "cf2", make_rows()[:2])
    heights = [s for s in flight_csv.load_content(flight).samples if s.topic == "/cf2/height"]
    assert len(heights) == 2


def test_a_flight_may_begin_at_0(flight: Path) -> None:
    for robot in ("cf1", "cf2"):
        write_log(flight, robot, make_rows(0.0))
    assert next(flight_csv.load_content(flight).samples).time_ns == 0


def test_similar_column_names_are_not_ranges(flight: Path) -> None:
    data: Rows = [[*row, 1.5, 1.5, 1.5] for row in make_rows()]
    write_log(flight, "cf1", data, [*HEADER, "range_cf2_s", "range_cf2", "my_range_cf2_m"])
    assert not [s for s in flight_csv.load_content(flight).samples if "range" in s.topic]


def test_pictures_are_named_by_digits(flight: Path) -> None:
    (flight / "cf1").mkdir()
    picture = encode_png(np.zeros((8, 8, 3), np.uint8))
    (flight / "cf1" / "notes-of-the-flight.txt").write_text("no picture")
    (flight / "cf1" / "001005000000.png").write_bytes(picture)
    assert list(flight_csv.load_content(flight).samples)
    (flight / "cf1" / "a_dozen_and_one.png").write_bytes(picture)
    with pytest.raises(SourceError, match=r"in nanoseconds, 12 digits or more\. Rename it"):
        flight_csv.load_content(flight)


def test_other_sensors_are_read_by_their_row_of_the_table(
    flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make_topic(pattern: str, message: str, *csv: str) -> topics.Topic:
        return topics.Topic(pattern, message, "-", "m", "10 Hz", "convert", sensor=True, csv=csv)

    pressure = make_topic("/{robot}/pressure", "Pressure", "pressure_pa", "air_c")
    sonar = make_topic("/{robot}/sonar/{peer}", "Sonar", "sonar_up_m", "echo_db")
    monkeypatch.setattr(flight_csv, "OTHER_SENSORS", (pressure, sonar))
    names = ["pressure_pa", "air_c", "sonar_up_cf2_m", "echo_cf2_db", "sonar_up_cf3_m"]
    data: Rows = [
        [*one, 1e5 + k, 20.5, 1.5 + k if k % 2 else "", -3.5, 7.0]
        for k, one in enumerate(make_rows())
    ]
    write_log(flight, "cf1", data, [*HEADER, *names])
    found = list(flight_csv.load_content(flight, Options(names={"cf1": "a", "cf2": "b"})).samples)
    of_air = [s for s in found if s.topic == "/a/pressure"]
    assert [s.fields for s in of_air] == [
        {"pressure_pa": 1e5 + k, "air_c": 20.5} for k in range(20)
    ]
    heard = [s for s in found if "sonar" in s.topic]
    assert {s.topic for s in heard} == {"/a/sonar/b"}  # cf3 lacks the column of the echo
    assert [(s.time_ns, s.message, s.fields) for s in heard] == [
        (10**9 + 10**7 * k, "Sonar", {"sonar_up_m": 1.5 + k, "echo_db": -3.5})
        for k in range(1, 20, 2)
    ]
    write_log(flight, "cf1", [line[:-4] for line in data], [*HEADER, names[0]])  # without air_c
    assert not [s for s in flight_csv.load_content(flight).samples if "pressure" in s.topic]
