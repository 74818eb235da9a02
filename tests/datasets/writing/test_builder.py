"""Building a dataset from recordings: rows, labels, masks, shards and refusals."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.cli import app
from dmrl.datasets import open_dataset
from dmrl.datasets.writing import dataset_writer
from dmrl.errors import MissingTopic, OutputError, RecordingError, SettingError
from dmrl.images.codec import encode_png
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_UNCONVERGED, message_class, serialize_schema
from dmrl.recording import Channel, Provenance, RawMessage, RecordingWriter, read
from dmrl.stages import convert
from dmrl.stages import dataset as stage
from dmrl.stages.dataset import MAX_NAMED, Settings, run
from dmrl.topics import CAMERA_IMAGE, LABELS

from ..conftest import HEIGHT_PX, STEP_NS, WIDTH_PX, Record, build_peer, draw_noise

pytestmark = pytest.mark.heavy

PLAIN = Settings()


def test_labelled_images_become_rows_with_recording_and_time(
    record: Record, tmp_path: Path
) -> None:
    run([record()], tmp_path / "out", PLAIN)
    rows = open_dataset(tmp_path / "out").split("train").table
    assert rows["log_time"].to_pylist() == [k * STEP_NS for k in range(6)]
    assert set(rows["source"].to_pylist()) == {"flight.mcap"}
    assert set(rows["robot"].to_pylist()) == {"cf1"}
    assert set(rows["split"].to_pylist()) == {"train"}


def test_dataset_pixels_equal_the_image(record: Record, tmp_path: Path) -> None:
    run([record()], tmp_path / "out", PLAIN)
    (got,) = open_dataset(tmp_path / "out").split("train").pixels
    assert np.array_equal(got, np.stack([draw_noise(k) for k in range(6)]))


def test_label_sets_its_grid_cell_and_keeps_its_fields(record: Record, tmp_path: Path) -> None:
    flight = record(peers=[[build_peer(sigma_u_px=2.0, box_px=[1, 2, 30, 40])]])
    run([flight], tmp_path / "out", PLAIN)
    split = open_dataset(tmp_path / "out").split("train")
    assert split.confidence.shape == split.depth.shape == (1, 6, 8)
    assert np.argwhere(split.confidence).tolist() == [[0, 1, 2]]
    assert split.depth[0, 1, 2] == np.float32(1.5)
    (got,) = split.table["peers"][0].as_py()
    assert (got["peer"], got["u_px"], got["v_px"]) == ("cf2", 20.5, 12.5)
    assert (got["sigma_u_px"], got["box_px"], got["status"]) == (2.0, [1, 2, 30, 40], "OK")


def test_masks_are_numbered_by_peer_index(record: Record, tmp_path: Path) -> None:
    numbers = np.zeros((48, 64), np.uint8)
    numbers[3, 4], numbers[5, 6], numbers[7, 8] = 2, 3, 9
    peers = [build_peer(peer="cf3"), build_peer(peer="painted2", u_px=40.0)]
    path = record(peers=[peers, [], peers], masks={0: numbers})
    for png, parquet in ((False, False), (True, True)):
        out = tmp_path / f"out-{parquet}"
        run([path], out, Settings(masks=True, png=png, parquet=parquet, split="none"))
        got = np.concatenate(open_dataset(out).split("train").masks)
        # The second image has no peers, so its mask is zero. The third is left out: it has peers
        # and no mask, and a mask of zeros would say that no peer is visible.
        assert got.shape == (2, 48, 64)
        assert {tuple(place): got[tuple(place)] for place in np.argwhere(got).tolist()} == {
            (0, 3, 4): 2,
            (0, 5, 6): 1,
        }


def test_images_without_masks_are_omitted_and_reported(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SettingError, match=r"flight\.mcap has no masks; renders have\. Leave out"):
        run([record()], tmp_path / "out", Settings(masks=True))
    zeros = np.zeros((48, 64), np.uint8)
    part = record("part.mcap", masks={0: zeros, 1: zeros}, seed=1)
    assert run([part], tmp_path / "out", Settings(masks=True)).images == {"train": 2}
    assert (
        "left out: images that show a peer, but have no mask (--masks): 4"
        in capsys.readouterr().err
    )


def test_estimated_labels_precede_truth_and_the_choice_is_reported(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = record(peers=[[build_peer(u_px=20.0), build_peer(source="estimate", u_px=30.0)]])
    for wanted, used, other in (("auto", "estimate", "truth"), ("best", "truth", "estimate")):
        out = tmp_path / wanted
        settings = Settings(split="none") if wanted == "auto" else Settings(wanted, split="none")
        assert run([flight], out, settings).sources == {"flight.mcap": used}
        assert f"labels from {used}, not from {other}, which is" in capsys.readouterr().err
        told = f"- `flight.mcap`: labels from `{used}` are used. It also has labels from `{other}`."
        assert told in (out / "README.md").read_text()


def test_thousands_of_recordings_are_counted_and_not_listed(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = [[build_peer(u_px=20.0), build_peer(source="estimate", u_px=30.0)]]
    flights = [record(f"f{k}.mcap", peers=both, seed=k) for k in range(MAX_NAMED + 1)]
    app(["dataset", *map(str, flights), str(tmp_path / "out")], result_action="return_value")
    said = capsys.readouterr()
    assert f"f0.mcap and {MAX_NAMED} more: labels from estimate" in said.err
    assert said.err.count("labels from") == 1 and "f1.mcap" not in said.out
    run(flights[:1], tmp_path / "stated", Settings(labels="truth", split="none"))
    assert "labels from" not in capsys.readouterr().err


def test_masks_are_omitted_by_default(record: Record, tmp_path: Path) -> None:
    run([record(masks={0: np.ones((48, 64), np.uint8)})], tmp_path / "out", PLAIN)
    split = open_dataset(tmp_path / "out").split("train")
    assert "masks" not in split.table.schema.names
    assert split.masks == []


def test_a_mask_of_another_size_is_refused_by_topic(record: Record, tmp_path: Path) -> None:
    path = record(masks={0: np.ones((24, 32), np.uint8)})
    with pytest.raises(RecordingError, match=r"masks at 0 ns is 32 x 24 px, its image 64 x 48"):
        run([path], tmp_path / "out", Settings(masks=True))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("fields", [{"u_px": 64.0}, {"v_px": -0.1}, {"depth_m": -1.0}])
def test_peer_outside_the_image_is_listed_but_sets_no_cell(
    record: Record, tmp_path: Path, fields: dict[str, float]
) -> None:
    run([record(peers=[[build_peer(**fields)]])], tmp_path / "out", PLAIN)
    split = open_dataset(tmp_path / "out").split("train")
    assert not split.confidence.any()
    assert len(split.table["peers"][0].as_py()) == 1


def test_images_without_peers_stay_and_unlabelled_ones_are_omitted(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = run([record(peers=[[build_peer()], [], None, None])], tmp_path / "out", PLAIN)
    assert result.images == {"train": 2}
    assert "left out: images that had no labels: 2" in capsys.readouterr().err


def test_the_best_source_wins_and_the_others_are_dropped(record: Record, tmp_path: Path) -> None:
    both = [build_peer(source="published", u_px=30.0), build_peer(source="truth", u_px=20.0)]
    flight = record(peers=[both])
    for wanted, u_px in (("best", 20.0), ("truth", 20.0), ("published", 30.0)):
        settings = Settings(labels=wanted)  # type: ignore[arg-type]  # parametrised literal
        run([flight], tmp_path / wanted, settings)
        (got,) = open_dataset(tmp_path / wanted).split("train").table["peers"][0].as_py()
        assert got["u_px"] == u_px


def test_image_labelled_by_another_source_only_is_no_negative(
    record: Record, tmp_path: Path
) -> None:
    flight = record(peers=[[build_peer(source="hand")], [build_peer(source="estimate")], []])
    result = run([flight], tmp_path / "out", Settings(labels="hand"))
    assert (result.images, result.tally.of_other_sources) == ({"train": 2}, 1)


def test_peer_without_position_makes_no_cell(record: Record, tmp_path: Path) -> None:
    anywhere = build_peer(status=STATUS_UNCONVERGED, sigma_u_px=WIDTH_PX, peer="cf3")
    run([record(peers=[[build_peer(), anywhere]])], tmp_path / "out", Settings(keep_all=True))
    (row,) = open_dataset(tmp_path / "out").split("train").table["peers"].to_pylist()
    assert [one["peer"] for one in row] == ["cf2"]


def test_different_focal_lengths_are_reported(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flights = []
    for name, focal_px in (("wide.mcap", 180.0), ("tele.mcap", 400.0)):
        flights.append(tmp_path / name)
        bare = record(f"of-{name}", seed=len(flights))
        with RecordingWriter(flights[-1], Provenance("test")) as sink:
            made = message_class("CameraCalibration")(K=[focal_px, 0, 32, 0, focal_px, 24, 0, 0, 1])
            sink.write(0, "/cf1/camera/calibration", made)
            for stamped in read(bare):
                sink.write(stamped.time_ns, stamped.topic, stamped.message)
    run(flights, tmp_path / "out", Settings())
    assert "focal lengths from 180 to 400 px" in capsys.readouterr().err
    assert open_dataset(tmp_path / "out").focal_px == [180.0, 400.0]


def test_unknown_label_source_error_lists_available_ones(record: Record, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"no labels from hand\. Try one of --labels truth"):
        run([record()], tmp_path / "out", Settings(labels="hand"))


def test_images_with_ambiguous_labels_are_omitted_without_keep_all(
    record: Record, tmp_path: Path
) -> None:
    doubtful = [build_peer(), build_peer(peer="cf3", status=STATUS_AMBIGUOUS)]
    flight = record(peers=[[build_peer()], doubtful])
    assert run([flight], tmp_path / "a", PLAIN).images == {"train": 1}
    assert run([flight], tmp_path / "b", Settings(keep_all=True)).images == {"train": 2}
    statuses = open_dataset(tmp_path / "b").split("train").table["peers"][1].as_py()
    assert [p["status"] for p in statuses] == ["OK", "AMBIGUOUS"]


def test_same_input_gives_the_same_bytes(record: Record, tmp_path: Path) -> None:
    flights = [record(), record("other.mcap", seed=1)]
    for name in ("a", "b"):
        run(flights, tmp_path / name, Settings(shard_images=4))
    files = [p.relative_to(tmp_path / "a") for p in sorted((tmp_path / "a").rglob("*"))]
    assert len(files) > 10
    for file in files:
        if (tmp_path / "a" / file).is_file():
            assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_any_number_of_threads_gives_the_same_bytes(record: Record, tmp_path: Path) -> None:
    paths = [record(), record("other.mcap", seed=1)]
    for workers in (1, 3):
        run(paths, tmp_path / f"out-{workers}", Settings(), workers=workers)
    one, three = (
        {p.name: p.read_bytes() for p in (tmp_path / f"out-{k}").rglob("*") if p.is_file()}
        for k in (1, 3)
    )
    assert one == three and "README.md" in one


def test_shards_hold_no_more_images_than_asked(record: Record, tmp_path: Path) -> None:
    run([record(peers=[[build_peer()]] * 150)], tmp_path / "out", Settings(shard_images=70))
    info = json.loads((tmp_path / "out/train/dataset_info.json").read_text())
    assert info["splits"]["train"]["shard_lengths"] == [70, 70, 10]
    split = open_dataset(tmp_path / "out").split("train")
    assert [len(p) for p in split.pixels] == [64, 6, 64, 6, 10]
    got = np.concatenate(split.pixels)
    assert np.array_equal(got, np.stack([draw_noise(k) for k in range(150)]))


def test_batch_of_large_images_is_limited_by_pixels(
    record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    batch = dataset_writer._build_record_batch
    monkeypatch.setattr(
        dataset_writer,
        "_build_record_batch",
        lambda rows, *more: made.append(len(rows)) or batch(rows, *more),
    )
    flight = record(peers=[[build_peer()]] * 5)
    for name, pixels, wanted in (("a", 10**9, [5]), ("b", 2 * WIDTH_PX * HEIGHT_PX, [2, 2, 1])):
        monkeypatch.setattr(dataset_writer, "MAX_BATCH_PIXELS", pixels)
        made.clear()
        run([flight], tmp_path / name, Settings())
        assert made == wanted
    monkeypatch.setattr(dataset_writer, "MAX_BATCH_PIXELS", 1)
    made.clear()
    run([flight], tmp_path / "c", Settings())
    assert made == [1] * 5


def test_images_of_two_sizes_are_refused_with_both_sizes(record: Record, tmp_path: Path) -> None:
    flight = record(sizes_px={4: (40, 64)})
    with pytest.raises(RecordingError, match=r"flight.mcap.* 64 x 40 px, .* 64 x 48 px.*convert"):
        run([flight], tmp_path / "out", PLAIN)


def test_a_size_that_is_no_multiple_of_eight_is_refused(record: Record, tmp_path: Path) -> None:
    flight = record(sizes_px={0: (244, 324)})
    with pytest.raises(RecordingError, match=r"324 x 244 px, not a multiple of 8 .*--width-px"):
        run([flight], tmp_path / "out", PLAIN)


def test_a_recording_without_labels_is_refused_by_topic(record: Record, tmp_path: Path) -> None:
    with pytest.raises(MissingTopic, match=r"no topic /\*/labels in .*flight.mcap"):
        run([record(peers=[None])], tmp_path / "out", PLAIN)


def test_a_topic_with_another_message_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        picture = message_class("CompressedImage")(data=encode_png(draw_noise(0)), format="png")
        sink.write(0, CAMERA_IMAGE("cf1"), picture)
        odd = Channel(LABELS("cf1"), "dmrl.v1.Height", serialize_schema("Height"))
        sink.write_raw(RawMessage(0, 0, odd, b""))
    with pytest.raises(RecordingError, match=r"/cf1/labels .*Height"):
        run([path], tmp_path / "out", PLAIN)


def test_recording_without_usable_images_reports_the_reason(record: Record, tmp_path: Path) -> None:
    flight = record(peers=[[build_peer(status=STATUS_AMBIGUOUS)]] * 3)
    with pytest.raises(RecordingError, match=r"images that had a label that is not OK .*: 3\."):
        run([flight], tmp_path / "out", PLAIN)
    assert [p.name for p in tmp_path.iterdir()] == ["flight.mcap"]


def test_datasets_are_never_overwritten(record: Record, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(OutputError, match="never overwritten"):
        run([record()], tmp_path / "out", PLAIN)
    assert list((tmp_path / "out").iterdir()) == []


def test_interrupted_run_leaves_no_dataset(
    record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    flight = record(peers=[[build_peer()]] * 100)
    monkeypatch.setattr("dmrl.datasets.writing.builder.require_same_size", die)
    with pytest.raises(KeyboardInterrupt):
        run([flight], tmp_path / "out", PLAIN)
    assert [p.name for p in tmp_path.iterdir()] == ["flight.mcap"]


def test_the_command_prints_images_and_label_sources(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = record()
    stage.command([flight], tmp_path / "out", as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["images"] == {"train": 6}
    assert printed["labels"] == {"flight.mcap": "truth"}
    stage.command([flight], tmp_path / "again")
    assert "flight.mcap" in capsys.readouterr().out


@pytest.mark.slow
def test_the_published_set_keeps_its_split_and_its_labels_by_source(
    data: Path, tmp_path: Path
) -> None:
    recording = tmp_path / "single.mcap"
    convert.run(data / "locanet-synthetic", recording, convert.Settings())
    for source in ("truth", "published"):
        result = run([recording], tmp_path / source, Settings(labels=source))  # type: ignore[arg-type]  # one of the choices
        assert result.images == {"train": 784, "test": 98}
    true, published = (
        open_dataset(tmp_path / source).split("test") for source in ("truth", "published")
    )
    shift = np.array(
        [
            [b[0]["u_px"] - a[0]["u_px"], b[0]["v_px"] - a[0]["v_px"]]
            for a, b in zip(
                true.table["peers"].to_pylist(), published.table["peers"].to_pylist(), strict=True
            )
        ]
    )
    # The published labels were projected with another camera model than the images.
    assert np.abs(np.median(shift, axis=0) - (2.0, 10.0)).max() < 1.0
    assert true.confidence.sum() == 98
