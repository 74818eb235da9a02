"""`dmrl predict`: detections, backends and errors."""

import json
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dmrl import prediction
from dmrl.deploy.detector import select_fastest_backend
from dmrl.deploy.onnx import runtime as onnx_run
from dmrl.errors import MissingTopic, ModelError, OutputError, RecordingError, SettingError
from dmrl.images.codec import ImageHeader, decode, encode_png
from dmrl.learn.inference.loaded_model import Model, load_model, save_model
from dmrl.learn.networks.architectures import build_network
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read, read_raw, read_summary
from dmrl.stages import predict
from dmrl.stages.predict import Settings, run
from dmrl.terminal.left_out import count_left_out

OWN = ("/cf1/detections", "/cf1/detections/grid")


def write_recording(path: Path, *sizes_px: tuple[int, int], robot: str = "cf1") -> Path:
    """Write images of these widths and heights."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for k, (width_px, height_px) in enumerate(sizes_px):
            data = encode_png(np.full((height_px, width_px, 3), 40 * k, np.uint8))
            picture = message_class("CompressedImage")(data=data, format="png")
            sink.write(k, f"/{robot}/camera/image", picture)
    return path


def test_everything_is_copied_bit_for_bit(dots: Path, model: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    result = run(model, dots, out, Settings(batch_size=7))
    assert result.images == 30
    copied = [raw for raw in read_raw(out) if raw.topic not in OWN]
    assert sorted(copied, key=lambda raw: (raw.time_ns, raw.topic)) == sorted(
        read_raw(dots), key=lambda raw: (raw.time_ns, raw.topic)
    )
    assert read_summary(out).metadata["dmrl.split"] == read_summary(dots).metadata["dmrl.split"]
    made = read_summary(out).provenance
    assert made is not None
    assert [source.name for source in made.inputs] == [model.name, "dots.mcap"]


def test_detections_have_the_time_of_their_image(dots: Path, model: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    run(model, dots, out, Settings())
    images = [(raw.time_ns, raw.publish_ns) for raw in read_raw(dots, "/cf1/camera/image")]
    for topic in OWN:
        assert [(raw.time_ns, raw.publish_ns) for raw in read_raw(out, topic)] == images


@pytest.mark.heavy
def test_extra_network_outputs_are_written_with_detections(dots: Path, tmp_path: Path) -> None:
    network = build_network("dmrl-nano", seed=1, extra=("log_spread", "class_0", "class_1")).eval()
    with torch.no_grad():
        network.head.bias[4:] = torch.tensor([-1.0, 0.0, 9.0])  # type: ignore[union-attr, index]
        network.head.weight[4:] = 0  # type: ignore[union-attr, index, operator]
    (tmp_path / "model").mkdir()
    save_model(Model(network, "dmrl-nano"), tmp_path / "model")
    run(tmp_path / "model", dots, tmp_path / "out.mcap", Settings())
    found = [d for s in read(tmp_path / "out.mcap", OWN[0]) for d in s.message.detections]
    assert len(found) >= 30
    assert {d.class_id for d in found} == {1}
    for d in found:
        assert d.sigma_depth_m == pytest.approx(2**0.5 * np.exp(-1) * d.depth_m)


def test_grid_equals_network_output_and_detections_are_its_peaks(
    dots: Path, model: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    run(model, dots, out, Settings(min_confidence=0.0, most=3))
    image = next(read(dots, "/cf1/camera/image")).message
    confidence, depth_m, *_ = load_model(model).grids(decode(image.data)[None])
    grid = next(read(out, OWN[1])).message
    assert (grid.rows, grid.cols, grid.stride_px) == (6, 8, 8)
    assert list(grid.channels) == ["confidence", "depth_m"]
    got = np.frombuffer(grid.data, "<f4").reshape(2, 6, 8)
    np.testing.assert_allclose(got, [confidence[0], depth_m[0]], rtol=1e-5)
    found = next(read(out, OWN[0])).message
    assert found.threshold == pytest.approx(0.4)
    assert 1 <= len(found.detections) <= 3
    best = found.detections[0]
    row, col = divmod(int(confidence[0].argmax()), 8)
    assert (best.u_px, best.v_px) == (8 * col + 4, 8 * row + 4)
    assert best.confidence == pytest.approx(confidence.max(), rel=1e-5)
    assert best.depth_m == pytest.approx(depth_m[0, row, col], rel=1e-5)


@pytest.mark.heavy
def test_two_views_see_the_same_in_an_image_and_its_mirror_image(tmp_path: Path) -> None:
    model = tmp_path / "model"
    model.mkdir()
    save_model(Model(build_network("dmrl-nano", seed=1).eval(), "dmrl-nano"), model)
    image = np.random.default_rng(5).integers(0, 255, (48, 64, 3), np.uint8)
    with RecordingWriter(tmp_path / "in.mcap", Provenance("test")) as sink:
        for k, picture in enumerate((image, image[:, ::-1].copy())):
            data = message_class("CompressedImage")(data=encode_png(picture), format="png")
            sink.write(k, "/cf1/camera/image", data)
    run(model, tmp_path / "in.mcap", tmp_path / "one.mcap", Settings())
    run(model, tmp_path / "in.mcap", tmp_path / "two.mcap", Settings(views=2))
    here, mirrored = (s.message.detections for s in read(tmp_path / "two.mcap", OWN[0]))
    assert len(here) == len(mirrored) > 1
    for one, other in zip(here, mirrored, strict=True):
        assert (one.u_px, one.v_px) == pytest.approx((64 - other.u_px, other.v_px), abs=1e-3)
        assert one.depth_m == pytest.approx(other.depth_m, rel=1e-4)
    alone = next(read(tmp_path / "one.mcap", OWN[0])).message.detections
    assert alone[0].u_px != here[0].u_px or alone[0].confidence != here[0].confidence


@pytest.mark.heavy
def test_earlier_detections_are_replaced(dots: Path, model: Path, tmp_path: Path) -> None:
    run(model, dots, tmp_path / "once.mcap", Settings())
    run(model, tmp_path / "once.mcap", tmp_path / "twice.mcap", Settings(threshold=0.9))
    topics = read_summary(tmp_path / "twice.mcap").topics
    assert {topics[topic].count for topic in OWN} == {30}
    assert next(read(tmp_path / "twice.mcap", OWN[0])).message.threshold == 0.9


def test_same_inputs_same_bytes(dots: Path, model: Path, tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        run(model, dots, tmp_path / name, Settings())
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_a_batch_may_be_larger_than_the_recording(dots: Path, model: Path, tmp_path: Path) -> None:
    assert run(model, dots, tmp_path / "out.mcap", Settings(batch_size=50)).images == 30
    assert read_summary(tmp_path / "out.mcap").count == 150


def test_images_of_several_sizes_go_through(model: Path, tmp_path: Path) -> None:
    mixed = write_recording(tmp_path / "mixed.mcap", (64, 48), (32, 32), (32, 32), (64, 48))
    run(model, mixed, tmp_path / "out.mcap", Settings())
    grids = [s.message for s in read(tmp_path / "out.mcap", OWN[1])]
    assert [(g.rows, g.cols) for g in grids] == [(6, 8), (4, 4), (4, 4), (6, 8)]


def test_an_image_of_a_size_that_the_model_does_not_take_is_left_out(
    model: Path, tmp_path: Path
) -> None:
    mixed = write_recording(tmp_path / "mixed.mcap", (60, 48), (64, 48))
    with count_left_out() as left:
        assert run(model, mixed, tmp_path / "out.mcap", Settings()).images == 1
    assert left.counts == {"images of a size that the model does not take": 1}


@pytest.mark.heavy
def test_batch_of_large_images_is_limited_by_pixels(
    dots: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    detect = prediction.detect_images
    monkeypatch.setattr(
        prediction, "detect_images", lambda p, *more: sizes.append(len(p)) or detect(p, *more)
    )
    run(model, dots, tmp_path / "a.mcap", Settings())
    monkeypatch.setattr("dmrl.guards.limits.FRAME_PIXELS", 4 * 64 * 48)
    run(model, dots, tmp_path / "b.mcap", Settings())
    assert sizes == [16, 14, *[4] * 7, 2]


@pytest.mark.heavy
def test_bad_input_is_one_line_and_leaves_nothing(dots: Path, model: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    odd = write_recording(tmp_path / "odd.mcap", (60, 48))
    with pytest.raises(SettingError, match=r"odd\.mcap: the image of .* 60 x 48 px do not divide"):
        run(model, odd, out, Settings())
    with RecordingWriter(tmp_path / "blind.mcap", Provenance("test")) as sink:
        sink.write(0, "/cf1/attitude", message_class("Attitude")())
    with pytest.raises(MissingTopic, match=r"no topic /\*/camera/image in"):
        run(model, tmp_path / "blind.mcap", out, Settings())
    with RecordingWriter(tmp_path / "noise.mcap", Provenance("test")) as sink:
        sink.write(0, "/cf1/camera/image", message_class("CompressedImage")(data=b"noise"))
    with pytest.raises(RecordingError, match=r"noise\.mcap: no image can be decoded"):
        run(model, tmp_path / "noise.mcap", out, Settings())
    with pytest.raises(ModelError, match="no model"):
        run(tmp_path / "nothing", dots, out, Settings())
    assert not list(tmp_path.glob("out*"))
    with pytest.raises(OutputError, match="exists"):
        run(model, odd, odd, Settings())


@pytest.mark.heavy
def test_the_weights_decide_the_provenance_and_not_the_log(
    dots: Path, model: Path, tmp_path: Path
) -> None:
    run(model, dots, tmp_path / "a.mcap", Settings())
    (model / "tensorboard").mkdir()
    (model / "tensorboard" / "events").write_text("later")
    run(model, dots, tmp_path / "b.mcap", Settings())
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_json_counts_images_and_detections(
    dots: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = replace(Settings(), threshold=1.0)
    predict.command(model, dots, tmp_path / "out.mcap", settings=settings, as_json=True)
    output = json.loads(capsys.readouterr().out)
    assert output.pop("left_out") == {}
    assert output == {"recording": str(tmp_path / "out.mcap"), "images": 30, "believed": 0}


def test_a_recording_in_place_of_the_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"seen\.mcap is a recording; the model comes first"):
        run(tmp_path / "seen.mcap", Path("dmrl-nano"), tmp_path / "out.mcap", Settings())


def test_an_unknown_model_is_refused_before_its_backend_is_named(
    dots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ModelError, match="no model dmrl-nan"):
        run(Path("dmrl-nan"), dots, tmp_path / "out.mcap", Settings())
    assert "--backend" not in capsys.readouterr().err


@pytest.mark.heavy
def test_fastest_backend_is_chosen_and_reported(
    dots: Path, random_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(random_model, dots, tmp_path / "out.mcap", Settings())
    assert f"{random_model} runs by onnx; --backend chooses another" in capsys.readouterr().err
    run(random_model, dots, tmp_path / "named.mcap", Settings(backend="onnx"))
    assert "--backend" not in capsys.readouterr().err
    assert (tmp_path / "out.mcap").read_bytes() == (tmp_path / "named.mcap").read_bytes()
    made = read_summary(tmp_path / "out.mcap").provenance
    assert made is not None and made.settings["backend"] == "onnx"
    assert "onnxruntime" in made.libraries


@pytest.mark.heavy
def test_torch_is_chosen_where_onnx_is_unsuitable(
    random_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert select_fastest_backend(random_model, (64, 48)) == "onnx"
    # An ONNX file has one image size.
    assert select_fastest_backend(random_model, (72, 48)) == "torch"
    (tmp_path / "more").mkdir()
    network = build_network("dmrl-nano", seed=1, extra=("log_spread",)).eval()
    save_model(Model(network, "dmrl-nano", width_px=64, height_px=48), tmp_path / "more")
    # Only torch returns the additional output.
    assert select_fastest_backend(tmp_path / "more", (64, 48)) == "torch"
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.delitem(sys.modules, "dmrl.deploy.onnx.runtime", raising=False)
    assert select_fastest_backend(random_model, (64, 48)) == "torch"


def test_onnxruntime_keeps_to_the_threads_of_a_worker(
    dots: Path, random_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    class SpySessionOptions(onnx_run.onnxruntime.SessionOptions):  # type: ignore[misc]
        def __setattr__(self, name: str, value: Any) -> None:
            asked.extend([value] * (name == "intra_op_num_threads"))
            super().__setattr__(name, value)

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(onnx_run.onnxruntime, "SessionOptions", SpySessionOptions)
    run(random_model, dots, tmp_path / "out.mcap", Settings(backend="onnx"))
    assert asked == [1]


def test_pictures_are_decoded_in_another_thread(
    dots: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: set[threading.Thread] = set()

    def decode_noted(picture: ImageHeader, most: int) -> Any:
        threads.add(threading.current_thread())
        return decoded(picture, most)

    decoded = ImageHeader.decode
    monkeypatch.setattr(ImageHeader, "decode", decode_noted)
    run(model, dots, tmp_path / "out.mcap", Settings(batch_size=3))
    assert threads and threading.main_thread() not in threads
