"""Trim, merge and recover recordings."""

from math import sin
from pathlib import Path

import pytest
from mcap.reader import make_reader

from dmrl.errors import MissingTopic, OutputError, RecordingError, SettingError
from dmrl.messages import message_class
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    merge,
    read,
    read_raw,
    read_splits,
    read_summary,
    recover,
    trim,
)
from dmrl.stages import trim as stage


def write_heights(path: Path, times_ns: list[int], split: str) -> Path:
    """Write heights at these times, and a split of this name that covers them."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for time_ns in times_ns:
            # A sine does not compress well, so that the chunks keep their size.
            sink.write(time_ns, "/cf1/height", message_class("Height")(height_m=sin(time_ns)))
        sink.add_metadata("dmrl.split", {split: f"[[{times_ns[0]}, {times_ns[-1]}]]"})
    return path


def test_merging_interleaves_by_time_and_keeps_every_bit(tmp_path: Path, flight: Path) -> None:
    other = write_heights(tmp_path / "b.mcap", [15_000_000, 25_000_000], "test")
    assert merge([flight, other], tmp_path / "out.mcap") == 4403
    merged = list(read_raw(tmp_path / "out.mcap"))
    assert [r.time_ns for r in merged] == sorted(r.time_ns for r in merged)
    assert [r for r in merged if r.topic == "/cf1/height"] == list(read_raw(other))
    assert read_splits(tmp_path, read_summary(tmp_path / "out.mcap")) == {
        "train": [(0, 10)],
        "test": [(15_000_000, 25_000_000)],
    }


def test_merged_recording_has_the_provenance_of_all_inputs(tmp_path: Path, flight: Path) -> None:
    trim(flight, tmp_path / "b.mcap", topics=["/cf1/attitude"])
    merge([flight, tmp_path / "b.mcap"], tmp_path / "out.mcap")
    made = read_summary(tmp_path / "out.mcap").provenance
    assert made is not None
    told = [(depth, s.provenance and s.provenance.stage) for depth, s in made.iter_ancestors()]
    assert told == [(0, "test"), (0, "trim"), (1, None)]
    last = made.inputs[1].provenance
    assert last is not None
    assert last.inputs[0].provenance == made.inputs[0].provenance


def test_a_recording_merged_with_itself_is_refused(tmp_path: Path, flight: Path) -> None:
    with pytest.raises(RecordingError, match="given twice"):
        merge([flight, flight], tmp_path / "out.mcap")


def test_trim_keeps_the_span_and_the_calibration(tmp_path: Path, flight: Path) -> None:
    out = tmp_path / "out.mcap"
    count = trim(flight, out, start_ns=10**9, end_ns=2 * 10**9)
    kept = list(read_raw(out))
    assert count == len(kept) == 111
    assert (kept[0].topic, kept[0].time_ns) == ("/cf1/camera/calibration", 10**9)
    assert kept[0].data == next(read_raw(flight, "/cf1/camera/calibration")).data
    assert {r.time_ns // 10**9 for r in kept} == {1}


def test_trim_seconds_count_from_the_recording_start(tmp_path: Path, flight: Path) -> None:
    last, few = tmp_path / "last.mcap", tmp_path / "few.mcap"
    stage.run(flight, last, stage.Settings(from_s=30.0))
    stage.run(last, few, stage.Settings(to_s=3.0))
    heights = [r for r in read_raw(few) if r.topic != "/cf1/camera/calibration"]
    assert {r.time_ns // 10**9 for r in heights} == {30, 31, 32}


def test_trim_keeps_the_calibration_valid_at_its_start(tmp_path: Path) -> None:
    every, out = tmp_path / "every.mcap", tmp_path / "out.mcap"
    with RecordingWriter(every, Provenance("test")) as sink:
        # As in ROS, the calibration of cf1 is repeated, and that of cf2 comes late.
        for k in range(1, 10):
            told = message_class("CameraCalibration")(width=8 * k)
            sink.write(10 * k, "/cf1/camera/calibration", told)
            sink.write(10 * k + 5, "/cf1/height", message_class("Height")(height_m=k))
        sink.write(95, "/cf2/camera/calibration", message_class("CameraCalibration")(width=8))

    def trim_and_list_calibrations(**stretch: int) -> list[tuple[str, int, int]]:
        out.unlink(missing_ok=True)
        trim(every, out, **stretch)
        found = read(out, "/*/camera/calibration")
        return sorted((m.topic[:4], m.time_ns, m.message.width // 8) for m in found)

    seen = [("/cf1", 44, 4), ("/cf1", 50, 5), ("/cf2", 44, 1)]
    assert trim_and_list_calibrations(start_ns=44, end_ns=56) == seen
    assert trim_and_list_calibrations(start_ns=50, end_ns=56) == [("/cf1", 50, 5), ("/cf2", 50, 1)]
    assert trim_and_list_calibrations(start_ns=-5, end_ns=16) == [("/cf1", 10, 1), ("/cf2", 10, 1)]
    assert trim_and_list_calibrations(start_ns=94) == [("/cf1", 94, 9), ("/cf2", 95, 1)]


def test_trimming_to_nothing_is_an_error_and_leaves_no_file(tmp_path: Path, flight: Path) -> None:
    with pytest.raises(RecordingError, match=r"no message in that time range; it lasts 39.990 s"):
        trim(flight, tmp_path / "out.mcap", start_ns=10**12)
    with pytest.raises(MissingTopic, match=r"Did you mean /cf1/attitude\?"):
        trim(flight, tmp_path / "out.mcap", topics=["/cf1/atitude"])
    with pytest.raises(OutputError, match="never overwritten"):
        trim(flight, flight)
    assert [p.name for p in tmp_path.iterdir()] == ["flight.mcap"]


def test_recover_returns_every_message_before_the_cut(tmp_path: Path, flight: Path) -> None:
    whole = list(read_raw(flight))
    data = flight.read_bytes()
    counts = []
    for k, share in enumerate((0.99, 0.6, 0.3)):
        (tmp_path / "cut.mcap").write_bytes(data[: int(len(data) * share)])
        try:
            result = recover(tmp_path / "cut.mcap", tmp_path / f"{k}.mcap")
        except RecordingError as e:
            assert "no whole chunk" in str(e)
            continue
        got = list(read_raw(tmp_path / f"{k}.mcap"))
        assert got == whole[: len(got)]
        assert result.messages == len(got)
        counts.append(len(got))
        made = read_summary(tmp_path / f"{k}.mcap").provenance
        assert made is not None
        assert made.inputs[0].provenance == Provenance("test", {"level": 1}, seed=3)
    assert counts == sorted(counts, reverse=True)
    assert counts


@pytest.mark.heavy
def test_recover_steps_over_a_damaged_chunk(tmp_path: Path) -> None:
    path = write_heights(tmp_path / "a.mcap", list(range(30_000)), "train")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    result = recover(path, tmp_path / "b.mcap")
    assert result.damaged_chunks == 1
    assert not result.whole
    times_ns = [r.time_ns for r in read_raw(tmp_path / "b.mcap")]
    assert 15_000 < len(times_ns) < 30_000
    assert times_ns[-1] == 29_999
    assert read_splits(tmp_path, read_summary(tmp_path / "b.mcap")) == {"train": [(0, 29_999)]}


@pytest.mark.heavy
def test_a_topic_whose_definition_is_damaged_is_not_lost(tmp_path: Path) -> None:
    path = write_heights(tmp_path / "a.mcap", list(range(60_000)), "train")
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        found = make_reader(stream).get_summary()
    assert found is not None
    first = found.chunk_indexes[0]
    assert len(found.chunk_indexes) > 1
    data[first.chunk_start_offset + first.chunk_length // 2] ^= 255
    path.write_bytes(data)
    result = recover(path, tmp_path / "b.mcap")
    assert (result.damaged_chunks, result.nameless, result.whole) == (1, 0, False)
    assert 0 < result.messages < 60_000


def test_messages_without_a_definition_are_counted(tmp_path: Path) -> None:
    # The file is truncated too, so nothing defines the topic of messages behind the damage.
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for time_ns in range(900):
            if time_ns in (300, 600):
                sink.flush()  # starts a new chunk
            sink.write(time_ns, "/cf1/height", message_class("Height")(height_m=sin(time_ns)))
            if time_ns >= 300:
                # The second topic shares its schema with the lost one.
                sink.write(
                    time_ns, "/cf1/attitude", message_class("Attitude")(roll_rad=sin(time_ns))
                )
                sink.write(time_ns, "/cf2/height", message_class("Height")(height_m=sin(time_ns)))
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        found = make_reader(stream).get_summary()
    assert found is not None
    first, last = found.chunk_indexes[0], found.chunk_indexes[-1]
    data[first.chunk_start_offset + first.chunk_length // 2] ^= 255
    path.write_bytes(data[: last.chunk_start_offset])
    result = recover(path, tmp_path / "b.mcap")
    assert result.nameless > 0
    assert {raw.topic for raw in read_raw(tmp_path / "b.mcap")} == {"/cf1/attitude"}


@pytest.mark.parametrize("seconds", [float("nan"), float("inf")])
def test_trim_refuses_non_finite_times(tmp_path: Path, flight: Path, seconds: float) -> None:
    with pytest.raises(SettingError, match="is no time"):
        stage.run(flight, tmp_path / "b.mcap", stage.Settings(to_s=seconds))


def test_merging_flights_of_the_same_robots_warns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = write_heights(tmp_path / "a.mcap", [0, 10], "train")
    other = write_heights(tmp_path / "b.mcap", [5, 15], "train")
    later = write_heights(tmp_path / "c.mcap", [20, 30], "train")
    merge([one, other], tmp_path / "mixed.mcap")
    assert "both have /cf1/height at the same time" in capsys.readouterr().err
    merge([one, later], tmp_path / "after.mcap")
    assert "both have /cf1/height, one after the other" in capsys.readouterr().err


def test_merging_parts_of_one_recording_does_not_warn(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    middle = read_summary(flight).start_ns + 5
    trim(flight, tmp_path / "a.mcap", end_ns=middle)
    trim(flight, tmp_path / "b.mcap", start_ns=middle)
    merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "out.mcap")
    assert capsys.readouterr().err == ""


def test_span_that_ends_before_it_begins_is_refused(tmp_path: Path, flight: Path) -> None:
    with pytest.raises(SettingError, match="--from-s 20 is not before --to-s 10"):
        stage.run(flight, tmp_path / "b.mcap", stage.Settings(from_s=20, to_s=10))


def test_name_of_a_new_recording_must_end_in_mcap(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"out is not named like a recording\. Use out\.mcap"):
        RecordingWriter(tmp_path / "out", Provenance("test"))
    assert not [*tmp_path.iterdir()]


def test_recovering_a_whole_recording_loses_nothing(tmp_path: Path, flight: Path) -> None:
    result = recover(flight, tmp_path / "b.mcap")
    assert result.whole
    assert list(read_raw(tmp_path / "b.mcap")) == list(read_raw(flight))


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r", b"\x89PNG\r\n\x1a\n", b"\x89MCAP0\r\n"])
def test_nothing_to_recover_is_an_error_and_leaves_no_file(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match="nothing to recover"):
        recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
