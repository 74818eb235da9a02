"""Undecodable images are omitted, counted and named; if all are, it is an error."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import boundary
from dmrl.cli import app
from dmrl.datasets import open_dataset
from dmrl.errors import RecordingError
from dmrl.images.codec import encode_jpeg, encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read, read_raw, read_summary
from dmrl.topics import CAMERA_IMAGE, LABELS

STEP_NS = 100_000_000
COUNT = 6
UNDECODABLE = {"images that cannot be decoded": 1}
PIXELS = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
JPEG, PNG = encode_jpeg(PIXELS), encode_png(PIXELS)

BROKEN = {
    "a cut JPEG": JPEG[: len(JPEG) // 2],
    "a cut PNG": PNG[: len(PNG) // 2],
    "no byte": b"",
    "other bytes": b"<html></html>",
    "a JPEG without pixels": JPEG[:300],
}


def write_recording(path: Path, broken_image: bytes, places: tuple[int, ...]) -> Path:
    """Write six labelled images, those at ``places`` broken."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(COUNT):
            kind = "png" if k % 2 else "jpeg"
            data = broken_image if k in places else (PNG if k % 2 else JPEG)
            image = message_class("CompressedImage")(data=data, format=kind)
            peer = {"peer": "cf2", "u_px": 20, "v_px": 20, "depth_m": 1, "source": "hand"}
            sink.write(k * STEP_NS, CAMERA_IMAGE("cf1"), image)
            sink.write(k * STEP_NS, LABELS("cf1"), message_class("PeerLabels")(peers=[peer]))
    return path


@pytest.fixture(params=list(BROKEN))
def broken_image(request: pytest.FixtureRequest) -> bytes:
    """Return an image that cannot be decoded."""
    return BROKEN[request.param]


@pytest.fixture(params=[0, 3, COUNT - 1])
def recording(request: pytest.FixtureRequest, broken_image: bytes, tmp_path: Path) -> Path:
    """Return a recording whose first, fourth or last image is broken."""
    return write_recording(tmp_path / "in.mcap", broken_image, (request.param,))


Run = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs a command.

    The function returns exit status, JSON document and standard error.
    """

    def command(*words: object) -> tuple[int, dict[str, Any], str]:
        status = boundary.run_to_status(lambda: app([str(word) for word in words]))
        printed = capsys.readouterr()
        told = json.loads(printed.out) if "--json" in words and printed.out else {}
        return status, told, printed.err

    return command


def find_time(recording: Path, data: bytes) -> int:
    """Return the time of the image with these bytes, nanoseconds."""
    (found,) = [s.time_ns for s in read(recording, CAMERA_IMAGE("cf1")) if s.message.data == data]
    return found


@pytest.mark.heavy
def test_predict_skips_broken_images(
    run: Run, recording: Path, broken_image: bytes, model: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    rc, told, output = run("predict", model, recording, out, "--json", "--backend", "torch")
    assert (rc, told["images"], told["left_out"]) == (0, COUNT - 1, UNDECODABLE)
    assert f"at {find_time(recording, broken_image)} ns" in output
    times = [raw.time_ns for raw in read_raw(out, "/cf1/detections")]
    assert sorted({*times, find_time(recording, broken_image)}) == [
        k * STEP_NS for k in range(COUNT)
    ]
    assert len(times) == COUNT - 1
    made = read_summary(out).provenance
    assert made is not None and made.left_out == UNDECODABLE
    rc, _, output = run("predict", model, recording, tmp_path / "no.mcap", "--json", "--strict")
    assert rc == 1 and "--strict" in output and not list(tmp_path.glob("no*"))


@pytest.mark.heavy
def test_dataset_skips_broken_images(
    run: Run, recording: Path, broken_image: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rc, told, output = run("dataset", recording, tmp_path / "set", "--json", "--test-share", 0)
    assert (rc, told["left_out"]) == (0, {"cannot be decoded": 1})
    assert f"at {find_time(recording, broken_image)} ns" in output
    times = open_dataset(tmp_path / "set").split("train").table["log_time"].to_pylist()
    assert sorted({*times, find_time(recording, broken_image)}) == [
        k * STEP_NS for k in range(COUNT)
    ]
    assert len(times) == COUNT - 1
    rc, _, output = run("dataset", recording, tmp_path / "no", "--json", "--strict")
    assert rc == 1 and "--strict" in output and not list(tmp_path.glob("no*"))


def test_check_reports_broken_images(run: Run, recording: Path, broken_image: bytes) -> None:
    rc, told, _ = run("check", recording, "--json")
    texts = [finding["text"] for finding in told["findings"]]
    wanted = f"1 messages contain no readable image: {find_time(recording, broken_image)} ns"
    assert rc == 1 and wanted in texts


def test_view_skips_broken_images(
    run: Run, recording: Path, broken_image: bytes, tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    rc, _, output = run("view", recording, "--save", tmp_path / "out.rrd")
    assert rc == 0
    where = f"{CAMERA_IMAGE('cf1')} at {find_time(recording, broken_image)} ns"
    assert f"left out: images that cannot be decoded: 1 (at {where})" in output


@pytest.mark.heavy
def test_evaluate_skips_broken_images(
    run: Run, recording: Path, model: Path, tmp_path: Path
) -> None:
    run("predict", model, recording, tmp_path / "out.mcap", "--json", "--backend", "torch")
    rc, told, _ = run("evaluate", tmp_path / "out.mcap", "--json", "--against", "hand", "--partial")
    assert (rc, told["images"]) == (0, COUNT - 1)


@pytest.mark.heavy
def test_only_broken_images_are_an_error(
    run: Run, broken_image: bytes, model: Path, tmp_path: Path
) -> None:
    recording = write_recording(tmp_path / "in.mcap", broken_image, tuple(range(COUNT)))
    for words in (("predict", model), ("dataset",), ("view",)):
        out = tmp_path / "out.mcap" if words[0] == "predict" else tmp_path / "out"
        flags = ("--save", tmp_path / "out.rrd") if words[0] == "view" else (out,)
        rc, _, said = run(*words, recording, *flags)
        assert rc == 1, words
        assert "decoded" in said
        assert not list(tmp_path.glob("out*"))


@pytest.mark.heavy
def test_third_party_recording_with_broken_image_is_processed(
    run: Run, data: Path, tmp_path: Path
) -> None:
    recording = data / "strangers/frame-jpeg_cut/bo_jpeg_cut_half.mcap"
    out = tmp_path / "out.mcap"
    rc, told, output = run("predict", "dmrl-nano", recording, out, "--json", "--backend", "torch")
    assert (rc, told["images"], told["left_out"]) == (0, 19, UNDECODABLE)
    assert "at 700000000 ns" in output
    _, told, _ = run("check", recording, "--json")
    assert any("700000000 ns" in finding["text"] for finding in told["findings"])


def test_python_api_raises_one_error_for_broken_images(
    broken_image: bytes, model: Path, tmp_path: Path
) -> None:
    from dmrl.stages import predict  # noqa: PLC0415 - needs torch

    recording = write_recording(tmp_path / "in.mcap", broken_image, tuple(range(COUNT)))
    with pytest.raises(RecordingError, match="no image can be decoded"):
        predict.run(model, recording, tmp_path / "out.mcap", predict.Settings(backend="torch"))
