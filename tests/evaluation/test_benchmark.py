"""The benchmark scores submitted networks and labels, and refuses copies of the truth."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dmrl import recipe as recipes
from dmrl.deploy.detector import open_detector, select_fastest_backend
from dmrl.errors import ModelError, SettingError, SourceError
from dmrl.evaluation.benchmark import COLUMNS, refuse_sealed, score_labels
from dmrl.recording import build_provenance, read_table
from dmrl.recording.provenance_inputs import build_input
from dmrl.stages import fly, label, trim

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

TRUTH = "/cf1/peer/cf2/truth"


def write_boxes(path: Path, rows: list[list[float]], threshold: str = "0.6") -> Path:
    """Write an ONNX detector that returns the same boxes for every image."""
    value = numpy_helper.from_array(np.array([rows], np.float32), "rows")
    image = helper.make_tensor_value_info("pixels", TensorProto.FLOAT, [1, 3, 224, 320])
    found = helper.make_tensor_value_info("found", TensorProto.FLOAT, list(np.shape([rows])))
    graph = helper.make_graph(
        [helper.make_node("Identity", ["rows"], ["found"])], "g", [image], [found], [value]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    model.metadata_props.add(key="threshold", value=threshold)
    onnx.save(model, path)
    return path


def write_maps(path: Path, rows: int = 28, red: float = 1 / 64) -> Path:
    """Write an ONNX network whose confidence is the mean red of a cell; its depth is constant."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, 224, 320])
    kernel = np.zeros((1, 3, 8, 8), np.float32)
    kernel[0, 0] = red
    weights = [numpy_helper.from_array(kernel, "kernel")]
    weights.append(numpy_helper.from_array(np.full((1, 1, rows, 40), 1.5, np.float32), "deep"))
    outs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 1, side, 40])
        for name, side in (("confidence", 28), ("depth_m", rows))
    ]
    nodes = [
        helper.make_node("Conv", ["image", "kernel"], ["confidence"], strides=[8, 8]),
        helper.make_node("Identity", ["deep"], ["depth_m"]),
    ]
    graph = helper.make_graph(nodes, "g", [image], outs, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, path)
    return path


def test_a_detectors_boxes_become_detections_with_depth(tmp_path: Path) -> None:
    boxes = [[100, 50, 124, 60, 0.9], [200.0, 100, 212, 104, 0.3], [-9, -9, -5, -5, 0.8]]
    file = write_boxes(tmp_path / "boxes.onnx", boxes)
    assert select_fastest_backend(file, (320, 224)) == "onnx"
    detector = open_detector(file, "onnx")
    assert (detector.threshold, detector.size_px) == (0.6, (320, 224))
    confidence, depth_m, offset, *_ = detector.grids([np.zeros((224, 320, 3), np.uint8)])
    assert confidence[0].max() == pytest.approx(0.9) and (confidence > 0).sum() == 2
    row, col = np.argwhere(confidence[0] > 0.5)[0]
    assert depth_m[0, row, col] == pytest.approx(183.73 * 0.13 / 24, rel=1e-4)
    at = (np.array([col, row]) + 0.5 + offset[0, :, row, col]) * 8
    assert at.tolist() == pytest.approx([112, 55])
    with pytest.raises(ModelError, match="torch cannot run"):
        open_detector(file, "torch")


def test_maps_are_read_by_name_and_others_refused(tmp_path: Path) -> None:
    detector = open_detector(write_maps(tmp_path / "maps.onnx"), "onnx")
    image = np.zeros((224, 320, 3), np.uint8)
    image[80:88, 160:168, 0] = 255
    confidence, depth_m, *_ = detector.grids([image])
    assert confidence[0, 10, 20] == pytest.approx(1.0) and depth_m[0, 0, 0] == 1.5
    with pytest.raises(ModelError, match="28 x 40"):
        open_detector(write_maps(tmp_path / "odd.onnx", 27), "onnx").grids([image])
    with pytest.raises(ModelError, match="its confidence is NaN"):
        open_detector(write_maps(tmp_path / "nan.onnx", red=np.nan), "onnx").grids([image])
    for threshold in ("nan", "2", "high"):
        with pytest.raises(ModelError, match=f"threshold is '{threshold}'. Give 0 to 1"):
            open_detector(write_boxes(tmp_path / "boxes.onnx", [[0.0] * 5], threshold), "onnx")
    (tmp_path / "torn.onnx").write_bytes(b"not a network")
    with pytest.raises(ModelError, match="cannot be run"):
        open_detector(tmp_path / "torn.onnx", "onnx")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Write a flight with truth, and the public recordings of it with and without ranges."""
    folder = tmp_path_factory.mktemp("scene")
    fly.run(folder / "scene.mcap", fly.Settings(seed=91_001, trajectory="random", duration_s=30))
    topic = ("/*/attitude", "/*/velocity", "/*/height", "/*/range/*")
    trim.run(folder / "scene.mcap", folder / "public.mcap", trim.Settings(topic=topic))
    trim.run(folder / "scene.mcap", folder / "blind.mcap", trim.Settings(topic=topic[:3]))
    return folder / "scene.mcap", folder / "public.mcap", folder / "blind.mcap"


def write_labels(path: Path, source: Path, scene: Path, error_m: float) -> Path:
    """Write the truth plus noise as submitted labels of a recording."""
    table = read_table(scene, TRUTH)
    rng, sha256 = np.random.default_rng(0), build_input(source).sha256
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for time_ns, *xyz in zip(
            *(table[k].to_pylist() for k in ("log_time", *"xyz")), strict=True
        ):
            xyz = (np.array(xyz) + rng.normal(0, error_m, 3)).tolist()
            writer.writerow([sha256, "cf1", "cf2", time_ns, *xyz, max(error_m, 0.01), 1])
    return path


@pytest.mark.heavy
def test_submitted_labels_are_scored_by_their_input_and_truth_is_refused(
    scene: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    whole, public, blind = scene
    inputs = {"label_with_uwb": [public], "label_without_uwb": [blind]}
    for task, (source,) in inputs.items():
        made = score_labels(
            write_labels(tmp_path / f"{task}.csv", source, whole, 0.1), [whole], inputs
        )
        assert list(made) == [task]
        assert made[task]["rmse_m"]["mean"] == pytest.approx(0.14, abs=0.01)
        assert made[task]["kept"]["mean"] == 1.0
    for source, error_m, word in ((public, 0.0, "are the truth"), (whole, 0.1, "holds the truth")):
        copied = write_labels(tmp_path / "copied.csv", source, whole, error_m)
        with pytest.raises(SettingError, match=word):
            score_labels(copied, [whole], inputs)
    (tmp_path / "odd.csv").write_text("a,b\n1,2\n")
    with pytest.raises(SourceError, match="sha256"):
        score_labels(tmp_path / "odd.csv", [whole], inputs)


@pytest.mark.heavy
def test_network_trained_on_sealed_flight_is_refused(
    scene: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    whole, _, _ = scene
    label.run(whole, tmp_path / "labelled.mcap", label.Settings())
    (tmp_path / "run").mkdir()
    made = build_provenance("train", None, [tmp_path / "labelled.mcap"])
    made.write(tmp_path / "run")
    network = write_maps(tmp_path / "run" / "model.onnx")
    with pytest.raises(SettingError, match="with its truth"):
        refuse_sealed(network, [whole])
    refuse_sealed(write_maps(tmp_path / "own.onnx"), [whole])


@pytest.mark.heavy
@pytest.mark.timeout(900)
def test_one_command_scores_a_submitted_network(tmp_path: Path) -> None:
    text = recipes.read_text("benchmark").replace('"blender"', '"sketch"')
    for long, short in (
        ("91001, 91002, 91003, 91004", "91001, 91002"),
        ("92001, 92002, 92003, 92004", "92001"),
        ("duration_s = 60.0", "duration_s = 25.0\ncamera_rate_hz = 1.0"),
        ('recipe = "fly_follow"', 'recipe = "fly_follow"\nduration_s = 4.0'),
    ):
        assert long in text
        text = text.replace(long, short)
    (tmp_path / "small.toml").write_text(text.replace('recipe = "fly_rendered"', "camera = true"))
    network = write_boxes(tmp_path / "stranger.onnx", [[150.0, 70, 180, 80, 0.9]])
    out = tmp_path / "out"
    line = [sys.executable, "-m", "dmrl.cli", "run", str(tmp_path / "small.toml")]
    done = subprocess.run(
        [*line, "--out", str(out), "--network", str(network)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    made = json.loads((out / "submission-stranger.json").read_text())
    assert len(made["tasks"]["detect"]["recall"]["values"]) == 2
    assert made["tasks"]["follow"]["held_s"]["mean"] > 0
    page = (out / "benchmark.html").read_text()
    for name in ("stranger", "dmrl-nano", "dmrl label, batch", "dmrl label, ekf", "Follow"):
        assert name in page
    copied = write_labels(
        tmp_path / "copied.csv", out / "public-91001.mcap", out / "scene-91001.mcap", 0.0
    )
    done = subprocess.run(
        [*line, "--out", str(out), "--labels", str(copied)], capture_output=True, text=True
    )
    assert done.returncode == 1 and "are the truth" in done.stderr
    assert not (out / "submission-copied.json").exists()
