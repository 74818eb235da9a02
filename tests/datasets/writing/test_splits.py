"""Splits of a dataset: given by recordings, held out by hash, and refusals."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.datasets import open_dataset
from dmrl.datasets.writing.splits import build_split_lookup, choose_test_recordings
from dmrl.errors import RecordingError, SettingError
from dmrl.messages import message_class
from dmrl.recording import (
    SPLIT_METADATA,
    Provenance,
    RecordingWriter,
    Summary,
    build_provenance,
    merge,
    read,
    read_splits,
    trim,
)
from dmrl.stages.dataset import Settings, run

from ..conftest import STEP_NS, Record, build_peer


@pytest.mark.heavy
def test_the_split_of_the_source_wins(record: Record, tmp_path: Path) -> None:
    own = {"train": f"[[0, {2 * STEP_NS}], [{5 * STEP_NS}, {5 * STEP_NS}]]"}
    own["test"] = f"[[{3 * STEP_NS}, {4 * STEP_NS}]]"
    result = run([record(split=own)], tmp_path / "out", Settings())
    assert result.images == {"train": 4, "test": 2}
    times = open_dataset(tmp_path / "out").split("test").table["log_time"].to_pylist()
    assert times == [3 * STEP_NS, 4 * STEP_NS]


@pytest.mark.heavy
def test_images_outside_every_span_are_left_out(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = {"train": "[[0, 0]]", "test": f"[[{STEP_NS}, {STEP_NS}]]"}
    run([record(split=own)], tmp_path / "out", Settings())
    assert (
        "left out: images that belong to no split of their source (--split): 4"
        in capsys.readouterr().err
    )


@pytest.mark.heavy
def test_the_split_of_the_source_can_be_ignored(record: Record, tmp_path: Path) -> None:
    flight = record(split={"train": "[[0, 0]]"})
    assert run([flight], tmp_path / "a", Settings(split="recordings")).images == {"train": 6}
    assert run([flight], tmp_path / "b", Settings(split="none")).images == {"train": 6}


@pytest.mark.heavy
def test_recordings_are_held_out_whole(record: Record, tmp_path: Path) -> None:
    flights = [record(f"{k}.mcap", seed=k) for k in range(5)]
    run(flights, tmp_path / "out", Settings(test_share=0.4))
    dataset = open_dataset(tmp_path / "out")
    held = set(dataset.split("test").table["source"].to_pylist())
    kept = set(dataset.split("train").table["source"].to_pylist())
    assert (len(held), len(kept), held & kept) == (2, 3, set())


@pytest.mark.heavy
def test_recordings_that_match_val_are_the_validation_split(record: Record, tmp_path: Path) -> None:
    own = {"train": "[[0, 0]]"}
    flights = [record(f"{k}.mcap", seed=k, split=own) for k in range(2)]
    flights.append(record("held.mcap", seed=2, split=own))
    run(flights, tmp_path / "out", Settings(val="held*", split="none"))
    dataset = open_dataset(tmp_path / "out")
    assert set(dataset.split("val").table["source"].to_pylist()) == {"held.mcap"}
    assert len(dataset.split("val")) == 6
    assert set(dataset.split("train").table["source"].to_pylist()) == {"0.mcap", "1.mcap"}
    with pytest.raises(SettingError, match=r"--val none matches none of 0\.mcap, 1\.mcap"):
        run(flights, tmp_path / "no", Settings(val="none"))


@pytest.mark.heavy
def test_one_recording_is_all_train_with_a_warning(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([record()], tmp_path / "out", Settings()).images == {"train": 6}
    assert "nothing is held out for testing. Name two or more" in capsys.readouterr().err


@pytest.mark.heavy
def test_no_warning_where_nothing_was_to_be_held_out(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run([record()], tmp_path / "out", Settings(split="none"))
    assert "held out" not in capsys.readouterr().err


@pytest.mark.parametrize(("count", "share", "held"), [(2, 0.01, 1), (10, 0.2, 2), (3, 0.99, 2)])
def test_at_least_one_recording_is_held_out_and_one_stays(
    count: int, share: float, held: int
) -> None:
    hashes = {Path(f"{k}.mcap"): f"{k:064x}" for k in range(count)}
    assert len(choose_test_recordings(hashes, share, 0)) == held


def test_the_choice_depends_on_content_and_seed_only() -> None:
    hashes = {Path(f"{k}.mcap"): f"{k:064x}" for k in range(20)}
    renamed = {Path(f"{99 - k}.mcap"): hashes[Path(f"{k}.mcap")] for k in reversed(range(20))}
    chosen = {hashes[path] for path in choose_test_recordings(hashes, 0.3, 0)}
    assert chosen == {renamed[path] for path in choose_test_recordings(renamed, 0.3, 0)}
    assert chosen != {hashes[path] for path in choose_test_recordings(hashes, 0.3, 1)}


@pytest.mark.parametrize("text", ["[[0]]", "[1, 2]", "train", "null", '[["a", 2]]'])
def test_a_split_that_is_no_list_of_spans_is_refused(text: str) -> None:
    with pytest.raises(RecordingError, match=r"x.mcap: its split is not a list of \[start_ns"):
        read_splits(Path("x.mcap"), Summary({}, 0, 0, {SPLIT_METADATA: [{"train": text}]}, {}))


def test_splits_that_share_a_time_are_refused() -> None:
    with pytest.raises(RecordingError, match=r"splits train and test share the time 5 ns"):
        build_split_lookup(Path("x.mcap"), {"train": [(0, 5)], "test": [(5, 9)]})


def test_two_recordings_of_one_name_are_refused(record: Record, tmp_path: Path) -> None:
    flights = [record("a/x.mcap"), record("b/x.mcap", seed=1)]
    with pytest.raises(SettingError, match="have the same name"):
        run(flights, tmp_path / "out", Settings())


def test_recording_and_one_derived_from_it_are_refused_together(
    record: Record, tmp_path: Path
) -> None:
    flight, copy = record("x.mcap"), tmp_path / "copy.mcap"
    trim(flight, copy)
    for both in ([flight, copy], [copy, flight]):
        with pytest.raises(
            SettingError, match=r"copy\.mcap is made from .*x\.mcap\. Name only one"
        ):
            run(both, tmp_path / "out", Settings())


@pytest.mark.heavy
def test_recording_and_render_of_its_dataset_are_accepted_together(
    record: Record, tmp_path: Path
) -> None:
    # A render over the images of a recording, or labels of its model, has it as ancestor.
    flight, other = record("x.mcap"), tmp_path / "over.mcap"
    run([flight], tmp_path / "set", Settings())
    with RecordingWriter(other, build_provenance("render", {}, [tmp_path / "set"])) as sink:
        for stamped in read(flight):
            sink.write(stamped.time_ns + 1, stamped.topic, stamped.message)
    assert sum(run([flight, other], tmp_path / "out", Settings()).images.values()) == 12


@pytest.mark.heavy
def test_splits_of_a_merged_recording_are_combined(record: Record, tmp_path: Path) -> None:
    # The merged recording has two consecutive flights, each with its own split.
    first = record(
        "a.mcap",
        split={"train": f"[[0, {2 * STEP_NS}]]", "test": f"[[{3 * STEP_NS}, {5 * STEP_NS}]]"},
    )
    second, both = tmp_path / "b.mcap", tmp_path / "both.mcap"
    with RecordingWriter(second, Provenance("test")) as sink:
        sink.add_metadata(SPLIT_METADATA, {"train": f"[[{10 * STEP_NS}, {15 * STEP_NS}]]"})
        for stamped in read(first):
            sink.write(stamped.time_ns + 10 * STEP_NS, stamped.topic, stamped.message)
    merge([first, second], both)
    assert run([both], tmp_path / "out", Settings()).images == {"train": 9, "test": 3}


def test_two_images_at_one_time_are_refused(record: Record, tmp_path: Path) -> None:
    merge([record("a.mcap"), record("b.mcap", seed=1)], tmp_path / "both.mcap")
    with pytest.raises(
        RecordingError, match="two images at 0 ns, as in a merge of flights of the same"
    ):
        run([tmp_path / "both.mcap"], tmp_path / "out", Settings())


@pytest.mark.heavy
def test_labels_doubled_by_a_merge_count_once(record: Record, tmp_path: Path) -> None:
    flight, more = record("a.mcap"), tmp_path / "b.mcap"
    with RecordingWriter(more, Provenance("test")) as sink:
        for stamped in read(flight, "/cf1/labels"):
            stamped.message.peers.append(build_peer(peer="cf3"))
            sink.write(stamped.time_ns, stamped.topic, stamped.message)
    merge([flight, more], tmp_path / "both.mcap")
    run([tmp_path / "both.mcap"], tmp_path / "out", Settings())
    rows = open_dataset(tmp_path / "out").split("train").table["peers"].to_pylist()
    assert [[found["peer"] for found in row] for row in rows] == [["cf2", "cf3"]] * 6

    with RecordingWriter(tmp_path / "c.mcap", Provenance("test")) as sink:
        labels = message_class("PeerLabels")(peers=[build_peer(u_px=21.0)])
        sink.write(0, "/cf1/labels", labels)
    merge([flight, tmp_path / "c.mcap"], tmp_path / "mixed.mcap")
    with pytest.raises(RecordingError, match="at 0 ns has different labels of cf2 from truth"):
        run([tmp_path / "mixed.mcap"], tmp_path / "out2", Settings())


def test_a_copy_of_a_recording_is_refused(record: Record, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="hold the same bytes"):
        run([record("x.mcap"), record("y.mcap")], tmp_path / "out", Settings())


@given(st.data())
@pytest.mark.heavy
def test_every_time_has_the_split_of_its_span(data: st.DataObject) -> None:
    edges = sorted(data.draw(st.sets(st.integers(0, 60), min_size=2, max_size=12)))
    spans = list(zip(edges[::2], edges[1::2], strict=False))
    names = [data.draw(st.sampled_from(["train", "test", "val"])) for _ in spans]
    own: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
    for k in data.draw(st.permutations(range(len(spans)))):
        own[names[k]].append(spans[k])
    split_of = build_split_lookup(Path("x.mcap"), own)
    for time_ns in range(-1, 62):
        there = [n for n, (start, end) in zip(names, spans, strict=True) if start <= time_ns <= end]
        assert split_of(time_ns) == (there[0] if there else None)


@given(st.sets(st.text("0123456789abcdef", min_size=8, max_size=8), max_size=30), st.floats(0, 1))
@pytest.mark.heavy
def test_held_out_share_is_met_and_grows_by_inclusion(hashes: set[str], share: float) -> None:
    content = {Path(f"{k}.mcap"): sha for k, sha in enumerate(sorted(hashes))}
    held, more = (
        choose_test_recordings(content, share, 3),
        choose_test_recordings(content, min(share + 0.2, 1), 3),
    )
    assert held <= more <= content.keys()
    if share > 0 and len(content) > 1:
        assert 1 <= len(held) < len(content)
        assert abs(len(held) - share * len(content)) <= 1
    else:
        assert not held
