"""`dmrl quantize`: the int8 model and its report."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from dmrl.cli import app
from dmrl.deploy.int8.layers import Conv
from dmrl.deploy.int8.store import load_network
from dmrl.errors import OutputError, SettingError
from dmrl.evaluation import quantization_report
from dmrl.images.codec import decode, encode_png
from dmrl.learn.inference.loaded_model import load_model
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.stages import convert, dataset
from dmrl.stages.quantize import Settings, run


@pytest.mark.heavy
def test_a_quantised_model_is_a_run_folder_with_more(
    quantised_model: Path, random_model: Path
) -> None:
    names = {path.name for path in quantised_model.iterdir()}
    assert names >= {"integer.npz", "samples.npz", "quantisation.json", "provenance.json"}
    wanted, got = (
        load_model(path).network.state_dict() for path in (random_model, quantised_model)
    )
    assert all((wanted[name] == got[name]).all() for name in wanted)
    network = load_network(quantised_model)
    assert (network.width_px, network.height_px, network.channels) == (64, 48, 3)
    assert network.architecture == load_model(random_model).architecture


@pytest.mark.heavy
def test_the_report_has_every_layer_and_both_accuracies(quantised_model: Path) -> None:
    said = json.loads((quantised_model / "quantisation.json").read_text())
    network = load_network(quantised_model)
    heads = {head.tensor for head in network.heads.values()}
    assert len(said["layers"]) == len(network.layers) - len(heads) + len(network.heads)
    assert all(layer["sqnr_db"] > 10 for layer in said["layers"] if layer["sqnr_db"] is not None)
    assert said["macs"] == sum(layer["products"] for layer in said["layers"]) > 10_000
    assert (said["split"], said["images"], said["calibration_images"]) == ("test", 10, 20)
    assert said["accuracy"].keys() == {"float", "int8"}
    assert said["accuracy"]["int8"]["median_px"] > 0


@pytest.mark.heavy
def test_same_inputs_same_bytes(
    random_model: Path, dots_dataset: Path, quantised_model: Path, tmp_path: Path
) -> None:
    again = tmp_path / random_model.name
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quantization_report, "plots", None)
        run(random_model, dots_dataset, again, Settings())
    for path in quantised_model.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes(), path.name


@pytest.mark.heavy
def test_float_and_int8_maps_are_drawn(model: Path, dots_dataset: Path, tmp_path: Path) -> None:
    sized = tmp_path / "model"
    shutil.copytree(model, sized)
    said = json.loads((sized / "model.json").read_text()) | {"width_px": 64, "height_px": 48}
    (sized / "model.json").write_text(json.dumps(said))
    result = run(sized, dots_dataset, tmp_path / "out", Settings(images=3, split="train", most=4))
    assert (result.calibration_images, result.split, result.images) == (3, "train", 4)
    height, width, _ = decode((tmp_path / "out" / "maps.png").read_bytes()).shape
    assert width > height > 100


@pytest.mark.heavy
def test_a_grey_network_takes_one_channel(
    random_model: Path, dots_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quantization_report, "plots", None)
    result = run(random_model, dots_dataset, tmp_path / "grey", Settings(grey=True))
    first = load_network(tmp_path / "grey").layers[0]
    assert isinstance(first, Conv)
    assert first.weight.shape[1] == result.network.channels == 1


def test_images_of_another_size_are_refused(
    model: Path, dots_dataset: Path, tmp_path: Path
) -> None:
    words = r"dots holds images of 64 x 48 px, .* takes 320 x 224\. Make a dataset of that size"
    with pytest.raises(SettingError, match=words):
        run(model, dots_dataset, tmp_path / "out", Settings())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.heavy
def test_constant_images_are_refused(
    random_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tmp_path / "plain.mcap"
    with RecordingWriter(recording, Provenance("test")) as sink:
        for k in range(4):
            data = encode_png(np.full((48, 64, 3), 60 * k, np.uint8))
            sink.write(
                k, "/cf1/camera/image", message_class("CompressedImage")(data=data, format="png")
            )
            peer = {"peer": "cf2", "u_px": 5, "v_px": 5, "depth_m": 1, "source": "truth"}
            sink.write(k, "/cf1/labels", message_class("PeerLabels")(peers=[peer]))
    dataset.run([recording], tmp_path / "plain", dataset.Settings())
    with pytest.raises(SettingError, match="calibration images is of a single colour"):
        run(random_model, tmp_path / "plain", tmp_path / "out", Settings())
    assert not list(tmp_path.glob("out*"))


def test_an_output_that_exists_is_kept(
    random_model: Path, dots_dataset: Path, tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(OutputError, match="exists"):
        run(random_model, dots_dataset, tmp_path / "out", Settings())


@pytest.mark.heavy
def test_the_command_prints_layers_and_accuracies(
    random_model: Path,
    dots_dataset: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(quantization_report, "plots", None)
    flags = [str(random_model), str(dots_dataset)]
    app(["quantize", *flags, str(tmp_path / "a")], result_action="return_value")
    printed = capsys.readouterr()
    assert "SQNR" in printed.out
    assert "most confident cell kept" in printed.out
    assert "pip install 'dmrl[plot]'" in printed.err
    app(["quantize", *flags, str(tmp_path / "b"), "--json"], result_action="return_value")
    output = json.loads(capsys.readouterr().out)
    assert output == json.loads((tmp_path / "b" / "quantisation.json").read_text())


@pytest.mark.slow
def test_int8_of_the_published_weights_is_as_good_as_float(data: Path, tmp_path: Path) -> None:
    convert.run(data / "locanet-synthetic", tmp_path / "single.mcap", convert.Settings())
    dataset.run([tmp_path / "single.mcap"], tmp_path / "dataset", dataset.Settings())
    weights = data / "locanet-weights" / "synthetic.h5"
    # All training images are used, so that one image counts about 0.1 %.
    result = run(weights, tmp_path / "dataset", tmp_path / "out", Settings(split="train"))
    wanted, got = result.accuracy["float"], result.accuracy["int8"]
    for name in ("within_20_px", "depth_mae_m"):
        assert wanted[name] is not None
        assert got[name] is not None
    assert got["within_20_px"] > wanted["within_20_px"] - 0.01
    assert got["depth_mae_m"] < 1.03 * wanted["depth_mae_m"]
