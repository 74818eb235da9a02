"""Appending to a dataset keeps its data, adds new data once, and survives being killed."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import load_dataset, load_from_disk

from dmrl.datasets import open_dataset
from dmrl.errors import BusyOutput, DatasetError, RecordingError, SettingError
from dmrl.guards.locks import take_folder
from dmrl.stages.dataset import Settings, add, run
from dmrl.stages.trim import Settings as Cut
from dmrl.stages.trim import run as trim

from ..conftest import Record, build_peer, draw_noise

pytestmark = pytest.mark.heavy

PLAIN = Settings(split="none", shard_images=4)
SHARDS = ((0, 2), (1, 2), (2, 4), (3, 4))
DESCRIPTIONS = ("README.md", "manifest.json", "provenance.json", "facts.json", "croissant.json")


def record_flights(record: Record, *numbers: int) -> list[Path]:
    """Write flights of six images; each number gives other images and times."""
    return [record(f"{k}.mcap", seed=k, begin_ns=k * 10**10) for k in numbers]


def read_contents(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def read_stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """Return modification time, ns, and inode of every file, which show whether it was written."""
    return {
        p.relative_to(folder).as_posix(): (p.stat().st_mtime_ns, p.stat().st_ino)
        for p in folder.rglob("*")
        if p.is_file()
    }


def list_sources(folder: Path, split: str = "train") -> list[str]:
    """Return the source recordings of a split, in the order of its rows."""
    found: list[str] = open_dataset(folder).split(split).table["source"].to_pylist()
    return list(dict.fromkeys(found))


@pytest.mark.parametrize("parquet", [False, True])
def test_appending_keeps_existing_shards_and_adds_new_ones(
    record: Record, tmp_path: Path, parquet: bool
) -> None:
    out, settings = tmp_path / "set", Settings(split="none", shard_images=4, parquet=parquet)
    run(record_flights(record, 0, 1), out, settings)
    before = read_stamps(out)
    assert add(record_flights(record, 2), out, Settings()).images == {"train": 6}
    after = read_stamps(out)
    changed = {name for name in before if before[name] != after[name]}
    changed = {name for name in changed if not name.startswith("figures/")}
    assert changed <= {*DESCRIPTIONS, "train/state.json", "train/dataset_info.json"}
    assert {"manifest.json", "provenance.json"} <= changed
    assert list_sources(out) == ["0.mcap", "1.mcap", "2.mcap"]
    split = open_dataset(out).split("train")
    shown = np.concatenate(split.pixels)
    assert np.array_equal(shown, [draw_noise(1000 * k + i) for k in range(3) for i in range(6)])
    made = json.loads((out / "provenance.json").read_text())
    assert [one["name"] for one in made["inputs"]] == ["0.mcap", "1.mcap", "2.mcap"]
    assert "18 camera images" in (out / "README.md").read_text()
    assert "`2.mcap`" in (out / "README.md").read_text()


def test_other_libraries_open_an_extended_dataset(record: Record, tmp_path: Path) -> None:
    out = tmp_path / "set"
    run(record_flights(record, 0), out, PLAIN)
    mark = load_from_disk(str(out))["train"]._fingerprint
    add(record_flights(record, 1), out, PLAIN)
    theirs = load_from_disk(str(out))["train"]
    assert theirs["source"] == ["0.mcap"] * 6 + ["1.mcap"] * 6
    assert bytes(theirs[7]["pixels"]) == draw_noise(1001).tobytes()
    assert theirs._fingerprint != mark
    info = json.loads((out / "train" / "dataset_info.json").read_text())["splits"]["train"]
    assert info["num_examples"] == 12 and info["shard_lengths"] == [4, 2, 4, 2]
    sizes = [path.stat().st_size for path in (out / "train").glob("*.arrow")]
    assert info["num_bytes"] == sum(sizes)


def test_shards_of_a_killed_append_are_ignored(record: Record, tmp_path: Path) -> None:
    """Parquet shards are listed by name, since a pattern would match those of a killed run."""
    out, settings = tmp_path / "set", Settings(split="none", shard_images=4, parquet=True)
    run(record_flights(record, 0), out, settings)
    shutil.copy(
        out / "data/train-00000-of-00002.parquet", out / "data/train-00002-of-00003.parquet"
    )
    assert len(load_dataset(str(out), cache_dir=str(tmp_path / "c"))["train"]) == 6
    add(record_flights(record, 1), out, settings)
    rows = load_dataset(str(out), cache_dir=str(tmp_path / "c"))["train"]
    assert rows["source"] == ["0.mcap"] * 6 + ["1.mcap"] * 6
    about = json.loads((out / "croissant.json").read_text())
    (files,) = about["distribution"]
    assert files["includes"] == [f"data/train-0000{k}-of-0000{n}.parquet" for k, n in SHARDS]


def test_appending_is_deterministic_and_idempotent(record: Record, tmp_path: Path) -> None:
    one, two, three = record_flights(record, 0, 1, 2)
    for name, workers in (("a", 1), ("b", 3)):
        run([one], tmp_path / name, Settings(test_share=0.5))
        add([two], tmp_path / name, Settings(), workers=workers)
        add([three], tmp_path / name, Settings(), workers=workers)
    made = read_contents(tmp_path / "a")
    assert made == read_contents(tmp_path / "b") and len(made) > 12
    again = add([three, one], tmp_path / "a", Settings())
    assert again.images == {} and read_contents(tmp_path / "a") == made


def test_existing_recordings_and_images_are_not_added_twice(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "set"
    (first,) = record_flights(record, 0)
    run([first], out, PLAIN)
    copied = shutil.copy(first, tmp_path / "copy.mcap")
    assert add([copied], out, PLAIN).images == {}
    assert "1 of 1 recordings are in" in capsys.readouterr().err
    # The file has the same images and one more, but other bytes and no provenance.
    more = record("more.mcap", [[build_peer()]] * 7, seed=0)
    result = add([more], out, PLAIN)
    assert result.images == {"train": 1} and result.tally.twice == 6
    assert len(open_dataset(out).split("train")) == 7
    card = (out / "README.md").read_text().replace("`", "")
    assert "are in the dataset already: same camera, time and pixels: 6" in card
    all_there = record("all.mcap", [[build_peer(depth_m=2.0)]] * 6, seed=0)
    assert add([all_there], out, PLAIN).images == {}
    assert add([all_there], out, PLAIN).tally.kept == 0


def test_append_refuses_repeated_names_parts_and_other_sizes(
    record: Record, tmp_path: Path
) -> None:
    out = tmp_path / "set"
    (first,) = record_flights(record, 0)
    run([first], out, PLAIN)
    made = read_contents(out)
    other = record("other/0.mcap", seed=5)
    with pytest.raises(SettingError, match="have the same name"):
        add([other], out, PLAIN)
    trim(first, tmp_path / "part.mcap", Cut(to_s=0.3))
    with pytest.raises(SettingError, match=r"part\.mcap is made from 0\.mcap"):
        add([tmp_path / "part.mcap"], out, PLAIN)
    with pytest.raises(RecordingError, match="64 x 40 px"):
        add([record("small.mcap", seed=6, sizes_px=dict.fromkeys(range(6), (40, 64)))], out, PLAIN)
    assert read_contents(out) == made


def test_append_requires_the_settings_of_the_dataset(record: Record, tmp_path: Path) -> None:
    out = tmp_path / "set"
    run(record_flights(record, 0), out, Settings(png=True, test_share=0.0))
    second = record_flights(record, 1)
    with pytest.raises(SettingError, match=r"made with --shard-images 2048\. Leave out"):
        add(second, out, Settings(shard_images=3))
    add(second, out, Settings(png=True))
    assert "image" in open_dataset(out).split("train").table.column_names


def test_split_of_a_flight_is_independent_of_other_flights(record: Record, tmp_path: Path) -> None:
    first, *others = record_flights(record, *range(8))
    for name, parts in (("a", [others]), ("b", [[one] for one in reversed(others)])):
        run([first], tmp_path / name, Settings(test_share=0.5))
        for part in parts:
            add(part, tmp_path / name, Settings())
    of = {name: set(list_sources(tmp_path / name, "test")) for name in "ab"}
    assert of["a"] == of["b"] and 0 < len(of["a"]) < 7
    assert "test" in (tmp_path / "b" / "dataset_dict.json").read_text()


def test_append_to_invalid_dataset_gives_one_line_error(record: Record, tmp_path: Path) -> None:
    out = tmp_path / "set"
    first, new = record_flights(record, 0), record_flights(record, 1)
    with pytest.raises(DatasetError, match="cannot be extended"):
        add(first, out, PLAIN)
    run(first, out, PLAIN)
    held = read_contents(out)
    for name, text in (
        ("manifest.json", b"[]"),
        ("manifest.json", held["manifest.json"].replace(b'"rows": 4', b'"rows": -4')),
        ("manifest.json", held["manifest.json"].replace(b'"parts": 1', b'"parts": 9')),
        ("manifest.json", held["manifest.json"].replace(b'"parts": 1', b'"parts": %d' % 10**17)),
        ("parts/00000/seen.bin", b"nothing"),
        ("parts/00000/seen.bin", held["parts/00000/seen.bin"][:-5]),
        ("parts/00000/seen.bin", held["parts/00000/seen.bin"][:-25]),
        ("parts/00000/provenance.json", b"{}"),
    ):
        (out / name).write_bytes(text)
        with pytest.raises((DatasetError, RecordingError), match="Make"):
            add(new, out, PLAIN)
        (out / name).write_bytes(held[name])
    held_by_another = take_folder(tmp_path / "set.partial")
    with pytest.raises(BusyOutput, match="being written by another"):
        add(new, out, PLAIN)
    os.close(held_by_another)
    assert read_contents(out) == held


def dies_at_change(at: int, work: Callable[[], Any]) -> bool:
    """Run work in a child that dies at its n-th change of a file; return whether it died."""
    child = os.fork()
    if child == 0:
        count = 0

        def count_calls(real: Callable[..., Any]) -> Callable[..., Any]:
            def call(*given: Any, **named: Any) -> Any:
                nonlocal count
                count += 1
                if count == at:
                    os._exit(9)
                return real(*given, **named)

            return call

        for name in ("replace", "rename", "mkdir", "fsync", "unlink", "rmdir"):
            setattr(os, name, count_calls(getattr(os, name)))
        work()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


@pytest.mark.parametrize(
    "step", [pytest.param(6, marks=pytest.mark.heavy), pytest.param(1, marks=pytest.mark.slow)]
)
def test_append_killed_at_any_file_change_leaves_old_or_new_dataset(
    record: Record, tmp_path: Path, step: int
) -> None:
    """A second run after the kill gives the same bytes as an uninterrupted one."""
    first, second, out = *record_flights(record, 0, 1), tmp_path / "set"
    settings = Settings(split="none", shard_images=3)
    run([first], tmp_path / "sound", settings)
    shutil.copytree(tmp_path / "sound", tmp_path / "grown")
    add([second], tmp_path / "grown", settings, workers=1)
    old, new = (read_contents(tmp_path / name) for name in ("sound", "grown"))
    rows, at, seen = set(), -2, True
    while seen:
        at += step
        shutil.copytree(tmp_path / "sound", out)
        seen = dies_at_change(at, lambda: add([second], out, settings, workers=1))
        here = len(open_dataset(out).split("train"))
        assert here == len(load_from_disk(str(out))["train"]) or here == 12
        assert here in (6, 12)
        rows.add((here, seen))
        left = read_contents(out)
        shards = [name for name in old if name.endswith((".arrow", ".bin"))]
        assert all(left[name] == old[name] for name in shards)
        add([second], out, settings, workers=1)
        assert read_contents(out) == new, at
        assert not list(tmp_path.glob("*.partial"))
        shutil.rmtree(out)
    assert {(6, True), (12, False)} <= rows <= {(6, True), (12, True), (12, False)} and at > 20
