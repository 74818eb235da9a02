"""`dmrl export`, and all backends on exported models."""

import json
from pathlib import Path

import numpy as np
import pytest

from dmrl.cli import app
from dmrl.deploy import detector
from dmrl.deploy.export_folder import list_files
from dmrl.errors import MissingExtra, ModelError, SettingError
from dmrl.recording import read, read_summary
from dmrl.stages import predict
from dmrl.stages.export import Settings, run

pytestmark = pytest.mark.heavy

INT8 = ("onnx-int8", "integer", "c")


@pytest.fixture(scope="session")
def exported_model(quantised_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the export of `quantised_model`."""
    out = tmp_path_factory.mktemp("exported") / quantised_model.name
    run(quantised_model, out, Settings())
    return out


def predict_grids(model: Path, recording: Path, out: Path, backend: str) -> np.ndarray:
    """Run a backend on a recording; return its (images, 2, rows, cols) maps.

    Channel 0 is the confidence, channel 1 the depth in metres.
    """
    file = out / f"{model.parent.name}-{backend}.mcap"
    predict.run(model, recording, file, predict.Settings(backend=backend))
    made = read_summary(file).provenance
    assert made is not None
    assert made.settings["backend"] == backend
    maps = [grid.message for grid in read(file, "/cf1/detections/grid")]
    shape = (2, maps[0].rows, maps[0].cols)
    return np.stack([np.frombuffer(grid.data, "<f4").reshape(shape) for grid in maps])


def test_every_backend_runs_a_quantised_model_and_an_export(
    quantised_model: Path, exported_model: Path, dots: Path, tmp_path: Path
) -> None:
    wanted = predict_grids(quantised_model, dots, tmp_path, "torch")
    assert np.ptp(wanted[:, 0]) > 0.1
    for model in (quantised_model, exported_model):
        onnx = predict_grids(model, dots, tmp_path, "onnx")
        np.testing.assert_allclose(onnx, wanted, rtol=1e-3, atol=1e-4)
    reference = predict_grids(quantised_model, dots, tmp_path, "integer")
    assert 0 < np.abs(reference[:, 0] - wanted[:, 0]).mean() < 0.1
    np.testing.assert_array_equal(
        predict_grids(exported_model, dots, tmp_path, "integer"), reference
    )
    np.testing.assert_array_equal(predict_grids(exported_model, dots, tmp_path, "c"), reference)
    for model in (quantised_model, exported_model):
        fast = predict_grids(model, dots, tmp_path, "onnx-int8")
        np.testing.assert_allclose(fast, reference, rtol=1e-5)  # equal integer levels


def test_export_lists_its_files(
    quantised_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "export"
    app(["export", str(quantised_model), str(out), "--json"], result_action="return_value")
    output = json.loads(capsys.readouterr().out)
    names = {path.name for path in out.iterdir()}
    c = quantised_model.name.replace("-", "_")
    assert output["files"].keys() == names
    assert names >= {"model.onnx", "model.int8.onnx", "integer.npz", f"{c}.c", f"{c}.h"}
    made = json.loads((out / "provenance.json").read_text())
    assert made["inputs"][0]["provenance"]["stage"] == "quantize"


def test_export_for_small_l1_reports_memory_placement(
    quantised_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, two, none = (tmp_path / name for name in ("whole", "two", "none"))
    said = []
    for out, kb in ((whole, 64), (two, 18)):
        words = ["export", str(quantised_model), str(out), "--l1-kb", str(kb), "--json"]
        app(words, result_action="return_value")
        said.append(json.loads(capsys.readouterr().out))
    assert said[0]["far_bytes"] == said[0]["traffic_bytes"] == 0
    if quantised_model.name == "dmrl-nano":
        assert said[1]["state_bytes"] <= 10 * 1024 < said[0]["state_bytes"]
        assert min(said[1]["far_bytes"], said[1]["traffic_bytes"]) > 0
    with pytest.raises(SettingError, match="Raise --l1-kb"):
        run(quantised_model, none, Settings(l1_kb=9))
    assert sorted(tmp_path.iterdir()) == [two, whole]


def test_a_float_model_becomes_float_onnx_alone(
    random_model: Path, dots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written = run(random_model, tmp_path / "export", Settings())
    assert {each.name for each in written} == {
        "model.onnx",
        "model.json",
        "provenance.json",
        "README.md",
    }
    assert f"dmrl quantize {random_model} DATASET OUT" in capsys.readouterr().err
    assert len(predict_grids(tmp_path / "export", dots, tmp_path, "onnx")) == 30


def test_same_inputs_same_bytes(
    quantised_model: Path, exported_model: Path, tmp_path: Path
) -> None:
    run(quantised_model, tmp_path / "again", Settings())
    for path in exported_model.iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes(), path.name


@pytest.mark.parametrize("backend", INT8)
def test_a_float_model_has_no_int8_backend(random_model: Path, backend: str) -> None:
    with pytest.raises(ModelError, match=rf"no int8 network, as --backend {backend} .*quantize"):
        detector.open_detector(random_model, backend)


def test_an_export_is_no_model_for_torch(exported_model: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="is an export folder, which torch cannot run"):
        detector.open_detector(exported_model, "torch")
    with pytest.raises(ModelError, match="is an export folder already"):
        run(exported_model, tmp_path / "again", Settings())


@pytest.mark.parametrize("backend", ["onnx", "onnx-int8", "integer"])
def test_images_of_another_size_are_refused(exported_model: Path, backend: str) -> None:
    opened = detector.open_detector(exported_model, backend)
    with pytest.raises(
        SettingError, match=r"an image: images of 72 x 48 px, .* takes only 64 x 48"
    ):
        opened.require_size(72, 48, "an image")


def test_a_missing_package_is_named_with_its_extra(
    random_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(name: str) -> None:
        raise ModuleNotFoundError(name="onnxruntime")

    monkeypatch.setattr(detector, "import_module", fail)
    with pytest.raises(MissingExtra, match=r"onnxruntime.* pip install 'dmrl\[deploy\]'"):
        detector.open_detector(random_model, "onnx")


@pytest.mark.parametrize("backend", detector.OPENERS)
def test_missing_model_is_reported(tmp_path: Path, backend: str) -> None:
    with pytest.raises(ModelError, match=r"no model .*nowhere"):
        detector.open_detector(tmp_path / "nowhere", backend)


def test_damaged_description_is_reported(exported_model: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in exported_model.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    (copy / "model.json").write_text("{}")
    with pytest.raises(ModelError, match=r"model.json is damaged"):
        detector.open_detector(copy, "onnx")


def test_every_file_of_an_export_is_described(exported_model: Path) -> None:
    told = {one.name: one.what for one in list_files(exported_model)}
    assert len(told) > 10 and [name for name, what in told.items() if not what] == []
    assert told["main.c"] != next(told[n] for n in told if n.endswith("_vectors.h"))
