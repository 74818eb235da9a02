"""Inputs and outputs in a bucket: the same bytes as local files, complete or absent."""

import os
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dmrl
from dmrl import boundary, topics
from dmrl.atomic_output import atomic_file, atomic_folder, replace_file
from dmrl.cli import app
from dmrl.datasets import open_dataset
from dmrl.errors import OutputError, StorageError, UnsafeName
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.pipeline.batch import build_tasks, find_recordings
from dmrl.recording import LoadedRecording, Provenance, RecordingWriter, iter_columns, read_summary
from dmrl.recording.mcap.chunks.chunk_reader import locate_chunk
from dmrl.recording.mcap.file import open_mcap
from dmrl.recording.mcap.summary_section import read_verified_section
from dmrl.recording.provenance_inputs import build_input, hash_file
from dmrl.storage import RemotePath, to_path
from dmrl.storage.remote import UNFINISHED_MARK

from ..pipeline.test_batch import write_recording
from .conftest import forget_filesystems

pytestmark = pytest.mark.filterwarnings("ignore")  # from botocore and aiohttp


def run_command(capsys: pytest.CaptureFixture[str], status: int, *words: object) -> Any:
    """Run a command, assert its exit status, and return what it printed."""
    given = [str(word) for word in words]
    found = boundary.run_to_status(lambda: app(given, result_action="return_value"))
    printed = capsys.readouterr()
    assert found == status, printed.err
    return printed


def write_flight_with_images(path: Path, *, seed: int = 0) -> Path:
    """Write attitudes of two robots, and labelled images with ten times as many bytes."""
    rng = np.random.default_rng(seed)
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(3000):
            at = 1_000_000_000 + k * 10_000_000
            for robot in ("cf1", "cf2"):
                roll, pitch = rng.normal(0, 0.1, 2).tolist()
                one = message_class("Attitude")(roll_rad=roll, pitch_rad=pitch)
                sink.write(at, topics.ATTITUDE(robot), one)
            if k % 10 == 0:
                data = encode_png(rng.integers(0, 255, (48, 64, 3), np.uint8))
                image = message_class("CompressedImage")(data=data, format="png")
                sink.write(at, topics.CAMERA_IMAGE("cf1"), image)
                peer = {"peer": "cf2", "u_px": 20, "v_px": 20, "depth_m": 1.0, "source": "truth"}
                sink.write(at, topics.LABELS("cf1"), message_class("PeerLabels")(peers=[peer]))
    return path


def test_bucket_urls_become_paths_and_other_names_stay_local() -> None:
    path = to_path("s3://lab/a/b.mcap")
    assert isinstance(path, RemotePath) and str(path) == "s3://lab/a/b.mcap"
    assert str(path.parent / "c.mcap") == "s3://lab/a/c.mcap" and path.suffix == ".mcap"
    assert str(path.with_suffix("")) == "s3://lab/a/b" and path.key == "lab/a/b.mcap"
    assert str(path.relative_to(to_path("s3://lab"))) == "a/b.mcap"
    assert str(pickle.loads(pickle.dumps(path))) == str(path)
    for plain in ("a.mcap", "/tmp/s3:/a", "s3:/lab/a", "c://a", "s3"):
        assert type(to_path(plain)) is type(Path())


@pytest.mark.heavy
def test_command_between_buckets_equals_local_output(
    lab: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_recording(tmp_path / "a.mcap")
    lab.put_file(str(source), "lab/one/a.mcap")
    run_command(capsys, 0, "trim", source, tmp_path / "b.mcap", "--to-s", 1)
    run_command(capsys, 0, "trim", "s3://lab/one/a.mcap", "s3://lab/one/b.mcap", "--to-s", 1)
    assert lab.cat_file("lab/one/b.mcap") == (tmp_path / "b.mcap").read_bytes()
    again = run_command(capsys, 1, "trim", source, "s3://lab/one/b.mcap", "--to-s", 1)
    assert again.err.startswith("dmrl: s3://lab/one/b.mcap exists.")
    assert sorted(lab.find("lab/one")) == ["lab/one/a.mcap", "lab/one/b.mcap"]
    assert "10 messages" in run_command(capsys, 0, "info", "s3://lab/one/b.mcap").out


@pytest.mark.heavy
def test_commands_work_on_folders_in_a_bucket(
    lab: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.mcap", "b/c.mcap", ".hidden/d.mcap"):
        lab.put_file(str(write_recording(tmp_path / name)), f"lab/many/{name}")
    words = ("trim", "s3://lab/many", "s3://lab/cut", "--to-s", 1, "--workers", 1)
    assert run_command(capsys, 0, *words).out.count("made") == 2
    assert sorted(lab.find("lab/cut")) == ["lab/cut/a.mcap", "lab/cut/b/c.mcap"]
    assert run_command(capsys, 0, *words).out.count("was there") == 2
    run_command(capsys, 0, "index", "s3://lab/many", "--workers", 1)
    assert "2 known" in run_command(capsys, 0, "index", "s3://lab/many").out
    found = run_command(
        capsys, 0, "find", "messages = 20", "s3://lab/many", "--paths"
    ).out.splitlines()
    assert found == ["s3://lab/many/a.mcap", "s3://lab/many/b/c.mcap"]
    assert run_command(capsys, 0, "check", "s3://lab/many/*.mcap").out.count("20 messages") == 1


@pytest.mark.heavy
def test_numbers_are_read_without_the_pictures(
    lab: Any, tmp_path: Path, fetched_bytes: list[int]
) -> None:
    source = write_flight_with_images(tmp_path / "a.mcap")
    path = to_path("s3://lab/pictured.mcap")
    with atomic_file(path) as here:
        here.write_bytes(source.read_bytes())
    size = source.stat().st_size
    topic = topics.ATTITUDE("cf1")
    held = LoadedRecording(path, topics.ATTITUDE)
    assert held.get_table(topic).equals(LoadedRecording(source, topics.ATTITUDE).get_table(topic))
    numbers = sum(len(block.data) for block, _ in held._messages.values())
    assert sum(fetched_bytes) < 0.3 * size
    assert numbers
    fetched_bytes.clear()
    assert sum(batch.num_rows for batch in iter_columns(path, topics.CAMERA_IMAGE("cf1"))) == 300
    assert 0.6 * size < sum(fetched_bytes) < 1.1 * size
    fetched_bytes.clear()
    assert build_input(path).sha256 == hash_file(source)  # from the object's metadata
    assert sum(fetched_bytes) < 0.1 * size
    assert read_summary(path).count == read_summary(source).count


@pytest.mark.heavy
def test_incomplete_bucket_output_is_invisible(lab: Any, tmp_path: Path) -> None:
    file, folder = to_path("s3://lab/whole/a.bin"), to_path("s3://lab/whole/set")
    with pytest.raises(RuntimeError), atomic_file(file) as here:
        here.write_bytes(b"half")
        raise RuntimeError
    with pytest.raises(RuntimeError), atomic_folder(folder) as here:
        (here / "a").write_bytes(b"half")
        raise RuntimeError
    assert lab.find("lab/whole") == []
    # A process that was killed during the upload leaves the mark; the folder counts as absent.
    lab.pipe_file(f"lab/whole/set/{UNFINISHED_MARK}", b"")
    lab.pipe_file("lab/whole/set/old", b"x")
    assert not folder.exists() and not folder.is_dir()
    with atomic_folder(folder) as here:
        (here / "in").mkdir()
        (here / "in" / "a").write_bytes(b"whole")
    assert folder.is_dir() and lab.find("lab/whole/set") == ["lab/whole/set/in/a"]
    with pytest.raises(OutputError, match="exists"), atomic_folder(folder):
        pass
    with replace_file(folder / "in" / "a") as here:
        here.write_bytes(b"again")
    assert (folder / "in" / "a").read_text() == "again"


@pytest.mark.heavy
def test_an_upload_that_fails_leaves_nothing(
    lab: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = to_path("s3://lab/torn")
    real, count = lab.put_file, []

    def fail_second_upload(*given: Any, **named: Any) -> None:
        count.append(given)
        if len(count) == 2:
            raise OSError("connection lost")
        real(*given, **named)

    monkeypatch.setattr(lab, "put_file", fail_second_upload)
    with pytest.raises(StorageError, match="connection lost"), atomic_folder(folder) as here:
        (here / "a").write_bytes(b"1")
        (here / "b").write_bytes(b"2")
    assert lab.find("lab/torn") == []


@pytest.mark.heavy
def test_a_dataset_is_made_and_opened_in_a_bucket(
    lab: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], empty_figures: None
) -> None:
    source = write_flight_with_images(tmp_path / "a.mcap")
    lab.put_file(str(source), "lab/sets/a.mcap")
    words = ("--split", "none", "--workers", 1)
    run_command(capsys, 0, "dataset", source, tmp_path / "set", *words)
    run_command(capsys, 0, "dataset", "s3://lab/sets/a.mcap", "s3://lab/sets/set", *words)
    here = open_dataset(tmp_path / "set").split("train")
    there = open_dataset(to_path("s3://lab/sets/set")).split("train")
    assert there.table.equals(here.table)
    made = (tmp_path / "set" / "train").glob("*.arrow")
    name = next(made)
    assert lab.cat_file(f"lab/sets/set/train/{name.name}") == name.read_bytes()


@pytest.mark.heavy
def test_a_dataset_in_a_bucket_grows_and_nothing_else_is_written(
    lab: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], empty_figures: None
) -> None:
    first, second = (write_flight_with_images(tmp_path / f"{k}.mcap", seed=k) for k in range(2))
    words = ("--split", "none", "--shard-images", 200, "--workers", 1)
    for out in (tmp_path / "set", "s3://lab/grows/set"):
        run_command(capsys, 0, "dataset", first, out, *words)
    before = {name: lab.info(name)["LastModified"] for name in lab.find("lab/grows/set")}
    shards = {name: lab.cat_file(name) for name in before if name.endswith(".arrow")}
    for out in (tmp_path / "set", "s3://lab/grows/set"):
        told = run_command(capsys, 0, "dataset", second, out, "--add", "--workers", 1)
    assert "the card is as it was" in told.err
    assert {name: lab.cat_file(name) for name in shards} == shards
    made = tmp_path / "set"
    # In a bucket, appending does not write the card again.
    card = re.compile(r"README\.md|croissant\.json|figures/.*")
    for path in (p for p in made.rglob("*") if p.is_file()):
        name = path.relative_to(made).as_posix()
        if not card.fullmatch(name):
            assert lab.cat_file(f"lab/grows/set/{name}") == path.read_bytes(), name
    again = run_command(capsys, 0, "dataset", second, "s3://lab/grows/set", "--add")
    assert "1 of 1 recordings are in" in again.err
    assert len(open_dataset(to_path("s3://lab/grows/set")).split("train")) == 600


@pytest.mark.heavy
def test_bucket_errors_are_one_line(
    lab: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lab.put_file(str(write_recording(tmp_path / "good.mcap")), "lab/wrong/good.mcap")
    lab.pipe_file("lab/wrong/text.mcap", b"no recording")
    for words, why in (
        (("info", "s3://nobody/a.mcap"), "there is no such bucket"),
        (("info", "s3://lab/nothing.mcap"), "no recording s3://lab/nothing.mcap"),
        (("info", "s3://lab/wrong/text.mcap"), "is not an MCAP file"),
        (("trim", "s3://lab/wrong/good.mcap", "s3://nobody/a.mcap"), "there is no such bucket"),
        (("trim", "s3://lab/wrong/good.mcap", "https://host/a.mcap"), "is on a web server. Copy"),
    ):
        line = run_command(capsys, 1, *words).err
        assert why in line and line.startswith("dmrl: ") and line.count("\n") == 1
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nowhere")
    forget_filesystems()
    assert "there are no credentials" in run_command(capsys, 1, "info", "s3://lab/a.mcap").err
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    monkeypatch.setattr("s3fs.core.S3FileSystem.retries", 1)
    forget_filesystems()
    assert "no server answers" in run_command(capsys, 1, "info", "s3://lab/a.mcap").err
    monkeypatch.undo()
    forget_filesystems()


@pytest.mark.slow
def test_label_reads_little_more_than_the_numbers(
    lab: Any, tmp_path: Path, fetched_bytes: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "flight.mcap"
    words = ("--duration-s", 12, "--seed", 1, "--camera")
    run_command(capsys, 0, "fly", "fly_in_view", source, *words)
    # An object that dmrl wrote has its hash as metadata.
    run_command(capsys, 0, "trim", source, "s3://lab/flight.mcap")
    path = to_path("s3://lab/flight.mcap")
    numbers, pictures = measure_chunks(path)
    assert pictures > 3 * numbers
    fetched_bytes.clear()
    made = tmp_path / "labels.mcap"
    run_command(capsys, 0, "label", path, made, "--no-copy")
    assert sum(fetched_bytes) <= 1.2 * numbers, (sum(fetched_bytes), numbers, pictures)
    run_command(capsys, 0, "label", path, tmp_path / "all.mcap")
    topic = topics.LABELS("cf1")
    ours = [m.peers for m in iter_estimated_labels(tmp_path / "all.mcap", topic)]
    assert ours == [m.peers for m in iter_estimated_labels(made, topic)]


def iter_estimated_labels(path: Path, topic: str) -> Any:
    """Yield the messages of labels with only the peers of source "estimate"."""
    for stamped in LoadedRecording(path, topics.LABELS).iter_messages(topic):
        others = [k for k, p in enumerate(stamped.message.peers) if p.source != "estimate"]
        for k in reversed(others):
            del stamped.message.peers[k]
        yield stamped.message


def measure_chunks(path: Path) -> tuple[int, int]:
    """Return the compressed bytes of all chunks without images, and of those with images."""
    sizes = [0, 0]
    with open_mcap(path) as stream:
        found = read_verified_section(stream)
        assert found is not None
        pictured = {n for n, c in found.channels.items() if "camera/image" in c.topic}
        for chunk in found.chunk_indexes:
            sizes[bool(pictured & chunk.message_index_offsets.keys())] += locate_chunk(chunk)[1]
    return sizes[0], sizes[1]


def test_bucket_keys_never_lead_outside_the_output_folder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Keys may be any text, but a copied folder must stay inside the output folder."""
    folder, hostile = RemotePath("s3://lab/set"), RemotePath("s3://lab/set/../../../victim")
    monkeypatch.setattr(RemotePath, "_info", lambda self: {"type": "directory"})
    monkeypatch.setattr(RemotePath, "list_files", lambda self: [hostile])
    with pytest.raises(UnsafeName, match="s3://lab/set: a file"):
        os.fspath(folder)


@pytest.mark.parametrize("key", ["x//b.mcap", "./b.mcap", "/b.mcap", "b?versionId=3.mcap"])
@pytest.mark.heavy
def test_keys_that_cannot_be_paths_are_refused(key: str, lab: Any) -> None:
    folder = f"lab/odd-{len(key)}-{key[0] == '/'}"
    for name in (f"{folder}/b", f"{folder}/b.mcap", f"{folder}/x/b.mcap", f"{folder}/sub/"):
        lab.pipe_file(name, b"another")
    assert [path.name for path in RemotePath(f"s3://{folder}").list_files()] == [
        "b",
        "b.mcap",
        "b.mcap",
    ]
    lab.call_s3("put_object", Bucket="lab", Key=f"{folder.removeprefix('lab/')}/{key}", Body=b"odd")
    for look in (RemotePath.list_files, lambda path: list(path.rglob("*.mcap")), os.fspath):
        with pytest.raises(StorageError, match="cannot be a path"):
            look(RemotePath(f"s3://{folder}"))


@pytest.mark.heavy
def test_keys_with_special_characters_stay_in_the_output_folder(lab: Any, tmp_path: Path) -> None:
    names = ("$(touch x).mcap", "-rf.mcap", "a%2Fb.mcap", "C:\\x.mcap")
    hidden = ("../../up.mcap", "dir/../../../up.mcap", ".hidden.mcap")
    for name in (*names, *hidden):
        lab.call_s3("put_object", Bucket="lab", Key=f"signs/{name}", Body=b"")
    found = find_recordings(to_path("s3://lab/signs"))
    assert {str(name) for name in found} == set(names)
    tasks = build_tasks("trim", "recording", found, tmp_path / "out")
    assert {task.out for task in tasks} == {tmp_path / "out" / name for name in names}


@pytest.mark.heavy
def test_python_api_reads_and_writes_buckets(lab: Any, tmp_path: Path) -> None:
    source = write_flight_with_images(tmp_path / "py.mcap")
    lab.put(str(source), "lab/py/a.mcap")
    found = dmrl.open("s3://lab/py/a.mcap")
    here = dmrl.open(source)
    assert str(found.path) == "s3://lab/py/a.mcap" and found.robots == here.robots
    assert len(found["/cf1/attitude"].to_arrow()) == 3000
    np.testing.assert_array_equal(found.images()[0], here.images()[0])
    cut = dmrl.trim(found, "s3://lab/py/b.mcap", to_s=1.0)
    assert cut["/cf1/attitude"].to_arrow() == dmrl.trim(here, to_s=1.0)["/cf1/attitude"].to_arrow()
    data = dmrl.make_dataset("s3://lab/py/a.mcap", "s3://lab/py/set")
    assert len(dmrl.dataset("s3://lab/py/set")["train"]) == len(data["train"])
    with dmrl.writer("s3://lab/py/own.mcap") as out:
        out.write("/cf1/height", 0.0, {"height_m": 0.4})
    assert len(dmrl.open("s3://lab/py/own.mcap")) == 1
