"""Models saved and loaded, and files that are refused."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from dmrl.errors import ModelError, SettingError
from dmrl.learn.inference.loaded_model import (
    Model,
    assign_weights,
    describe,
    get_weights,
    interpolate_weights,
    load_model,
    save_model,
    transfer_weights,
)
from dmrl.learn.networks.architectures import build_network


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return a run folder with an untrained network."""
    folder = tmp_path / "run"
    folder.mkdir()
    network = build_network("locanet", seed=3).eval()
    save_model(Model(network, "locanet", threshold=0.4, label_source="truth"), folder)
    return folder


class Bomb:
    """An object whose pickle creates a file when it is opened."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (self.mark,)  # type: ignore[return-value]


def test_a_loaded_model_gives_the_grids_of_the_saved_one(run: Path) -> None:
    images = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), np.uint8)
    wanted = Model(build_network("locanet", seed=3).eval(), "locanet").grids(images)
    for path in (run, run / "model.safetensors"):
        model = load_model(path)
        assert (model.threshold, model.label_source) == (0.4, "truth")
        got = model.grids(images)
        np.testing.assert_array_equal(got.confidence, wanted.confidence)
        np.testing.assert_array_equal(got.depth_m, wanted.depth_m)
        assert got.confidence.shape == got.depth_m.shape == (2, 8, 8)
        assert got.offset is None


def test_dmrl_nano_predicts_an_offset_within_the_cell(tmp_path: Path) -> None:
    network = build_network("dmrl-nano", seed=1).eval()
    with torch.no_grad():
        network.head.bias[2:] = torch.tensor([0.25, -0.5])  # type: ignore[union-attr, index]
        network.head.weight.zero_()  # type: ignore[union-attr, operator]
    save_model(Model(network, "dmrl-nano"), tmp_path)
    grids = load_model(tmp_path).grids(np.zeros((1, 16, 24, 3), np.uint8))
    assert grids.offset is not None
    assert grids.offset.shape == (1, 2, 2, 3)
    assert grids.offset[0, :, 1, 2].tolist() == [0.25, -0.5]
    said = json.loads((tmp_path / "model.json").read_text())
    assert said["outputs"] == ["log_depth", "confidence", "offset_u", "offset_v"]


def test_model_with_extra_channels_round_trips(tmp_path: Path) -> None:
    extra = ("log_spread", "class_0", "class_1")
    network = build_network("dmrl-nano", seed=1, extra=extra).eval()
    with torch.no_grad():
        network.head.bias[4:] = torch.tensor([-1.0, 0.5, 0.6])  # type: ignore[union-attr, index]
        network.head.weight.zero_()  # type: ignore[union-attr, operator]
    save_model(Model(network, "dmrl-nano"), tmp_path)
    grids = load_model(tmp_path).grids(np.zeros((1, 16, 24, 3), np.uint8))
    assert grids.spread is not None
    assert grids.class_id is not None
    np.testing.assert_allclose(grids.spread, np.exp(-1), rtol=1e-6)
    assert (grids.class_id == 1).all()


def test_a_description_with_unknown_outputs_is_refused(run: Path) -> None:
    said = json.loads((run / "model.json").read_text())
    for outputs in (["log_depth"], [*said["outputs"], "class_1"], 3):
        (run / "model.json").write_text(json.dumps(said | {"outputs": outputs}))
        with pytest.raises(ModelError, match=r"model\.json has no valid outputs"):
            load_model(run)


def test_weights_are_transferred_to_a_network_with_more_channels() -> None:
    known, fresh = (
        build_network("dmrl-nano", seed=1),
        build_network("dmrl-nano", seed=2, extra=("log_spread",)),
    )
    wanted, new = get_weights(known), get_weights(fresh)
    got = transfer_weights(known, fresh)
    assign_weights(fresh, got, "here")
    assert torch.equal(got["head.weight"][:4], wanted["head.weight"])
    assert torch.equal(got["head.weight"][4:], new["head.weight"][4:])
    assert torch.equal(got["body.0.0.weight"], wanted["body.0.0.weight"])


def test_run_folders_without_outputs_key_still_load(run: Path) -> None:
    said = json.loads((run / "model.json").read_text())
    del said["outputs"]
    (run / "model.json").write_text(json.dumps(said))
    assert load_model(run).threshold == 0.4


def test_saving_twice_gives_the_same_bytes(run: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    again.mkdir()
    save_model(load_model(run), again)
    for name in ("model.safetensors", "model.json"):
        assert (again / name).read_bytes() == (run / name).read_bytes()


@pytest.mark.parametrize("name", ["weights.h5", "weights.safetensors", "weights.pt"])
def test_a_pickle_is_refused_and_never_opened(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(pickle.dumps(Bomb(tmp_path / "exploded")))
    with pytest.raises(ModelError, match="is a pickle, which can run any code"):
        load_model(path)
    assert not (tmp_path / "exploded").exists()


def test_a_torch_file_is_refused(tmp_path: Path) -> None:
    torch.save({"weight": torch.zeros(2)}, tmp_path / "weights.pt")
    with pytest.raises(ModelError, match=r"is a pickle.*Give a run folder"):
        load_model(tmp_path / "weights.pt")


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n" + bytes(20)])
def test_a_file_of_another_format_is_not_a_model(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "weights"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"is not a model\. Give a run folder"):
        load_model(path)


def test_missing_model_gives_one_line_error(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no model"):
        load_model(tmp_path / "nothing")
    with pytest.raises(ModelError, match=r"no model\.safetensors in"):
        load_model(tmp_path)


def test_a_tensor_of_another_shape_is_named_with_both_shapes(run: Path) -> None:
    tensors = load_file(run / "model.safetensors")
    tensors["head.bias"] = torch.zeros(3)
    save_file(tensors, run / "model.safetensors")
    with pytest.raises(ModelError, match=r"head\.bias has shape \(3,\), the network needs \(2,\)"):
        load_model(run)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda t: t.pop("head.bias"), r"lacks tensor head\.bias"),
        (lambda t: t.update(extra=torch.zeros(1)), "has an unknown tensor extra"),
        (lambda t: t["head.bias"].fill_(float("nan")), r"head\.bias holds values .* not finite"),
    ],
)
def test_wrong_tensors_are_named(run: Path, change: object, text: str) -> None:
    tensors = load_file(run / "model.safetensors")
    change(tensors)  # type: ignore[operator]
    save_file(tensors, run / "model.safetensors")
    with pytest.raises(ModelError, match=text):
        load_model(run)


def test_damaged_weights_give_one_line_errors(run: Path) -> None:
    whole = (run / "model.safetensors").read_bytes()
    (run / "model.safetensors").write_bytes(whole[:-100])
    with pytest.raises(ModelError, match="is damaged"):
        load_model(run)


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("threshold", "high", "has no valid threshold"),
        (
            "architecture",
            "resnet",
            "requires architecture resnet, this dmrl has dmrl-large, dmrl-nano, ",
        ),
    ],
)
def test_a_wrong_description_is_refused_by_its_key(
    run: Path, key: str, value: str, text: str
) -> None:
    said = json.loads((run / "model.json").read_text())
    (run / "model.json").write_text(json.dumps({**said, key: value}))
    with pytest.raises(ModelError, match=text):
        load_model(run)
    (run / "model.json").write_text("{")
    with pytest.raises(ModelError, match="is not JSON"):
        load_model(run)


def test_images_that_do_not_divide_into_cells_are_refused(run: Path) -> None:
    with pytest.raises(SettingError, match="324 x 244 px do not divide into cells of 8 px"):
        load_model(run).grids(np.zeros((1, 244, 324, 3), np.uint8))


@pytest.mark.parametrize("kind", [torch.int64, torch.bool, torch.complex64, torch.float8_e4m3fn])
def test_weights_of_other_dtypes_are_refused(run: Path, kind: torch.dtype) -> None:
    tensors = load_file(run / "model.safetensors")
    save_file({k: v.to(kind) for k, v in tensors.items()}, run / "model.safetensors")
    with pytest.raises(ModelError, match=r"holds torch\.\w+. Give weights in float32"):
        load_model(run)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
@pytest.mark.heavy
def test_weights_are_interpolated_by_a_fraction(share: float) -> None:
    network, first = build_network("locanet", seed=1), get_weights(build_network("locanet", seed=2))
    before = {name: value.clone() for name, value in get_weights(network).items()}
    assert not any(name.endswith("num_batches_tracked") for name in before)
    del first["head.bias"]  # A tensor that the others lack stays as it is.
    interpolate_weights(network, first, share)
    for name, value in get_weights(network).items():
        other = first.get(name, before[name])
        torch.testing.assert_close(value, (1 - share) * before[name] + share * other)


@pytest.mark.parametrize(
    ("change", "fits"),
    [
        ({"width_px": 0}, False),
        ({"width_px": -8, "height_px": -8}, False),
        ({"width_px": 1 << 20, "height_px": 1 << 20}, False),
        ({"width_px": 8, "height_px": 8}, True),
        ({"threshold": float("inf")}, False),
        ({"threshold": 1}, True),
        ({"width_px": 8.0}, False),
        ({"label_source": 3}, False),
        ({"training": []}, False),
    ],
)
def test_a_description_with_impossible_sizes_or_numbers_is_refused(
    run: Path, change: dict[str, object], fits: bool
) -> None:
    said = json.loads((run / "model.json").read_text())
    (run / "model.json").write_text(json.dumps(said | change))
    if fits:
        model = load_model(run)
        assert {name: getattr(model, name) for name in change} == change
    else:
        with pytest.raises(
            ModelError, match=r"model\.json (has no valid|is for images|is not JSON)"
        ):
            load_model(run)


def test_the_description_of_a_model_has_its_properties() -> None:
    network = build_network("dmrl-nano", extra=("log_spread",))
    model = Model(network, "dmrl-nano", "n", 64, 48, 0.25, "truth", {"epochs": 3})
    assert describe(model) == {
        "architecture": "dmrl-nano",
        "parameters": sum(p.numel() for p in network.parameters()),
        "width_px": 64,
        "height_px": 48,
        "stride_px": 8,
        "focal_px": [],
        "channels": 3,
        "outputs": ["log_depth", "confidence", "offset_u", "offset_v", "log_spread"],
        "threshold": 0.25,
        "label_source": "truth",
        "rates": None,
        "training": {"epochs": 3},
    }


@pytest.mark.parametrize(("size", "fits"), [((64, 48), True), ((60, 48), False), ((64, 44), False)])
def test_width_and_height_must_be_whole_cells(size: tuple[int, int], fits: bool) -> None:
    model = Model(build_network("locanet"), "locanet")
    if fits:
        model.require_size(*size, "here")
    else:
        with pytest.raises(SettingError, match=f"here: images of {size[0]} x {size[1]} px"):
            model.require_size(*size, "here")
