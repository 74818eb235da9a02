"""Published Keras weights, loaded and compared with a network in NumPy."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dmrl.errors import MissingExtra, ModelError
from dmrl.learn.inference.loaded_model import load_model
from dmrl.learn.networks import hdf5_arrays
from dmrl.learn.networks.architectures import normalize_images
from dmrl.learn.networks.keras_weights import load_keras_weights

pytestmark = pytest.mark.heavy

WIDTHS = (3, 8, 16, 32, 64)
Variables = dict[str, NDArray[np.float32]]


def draw_variables() -> Variables:
    """Draw a random value of every variable of a published file, by its path in the file."""
    rng = np.random.default_rng(0)
    out: Variables = {}
    for k in range(4):
        tail = f"_{k}" if k else ""
        conv, norm = f"conv2d{tail}", f"batch_normalization{tail}"
        out[f"{conv}/{conv}/kernel:0"] = rng.normal(size=(3, 3, *WIDTHS[k : k + 2]))
        for name in ("gamma", "beta", "moving_mean", "moving_variance"):
            out[f"{norm}/{norm}/{name}:0"] = rng.uniform(0.5, 1.5, WIDTHS[k + 1])
    out["conv2d_4/conv2d_4/kernel:0"] = rng.normal(size=(1, 1, 64, 2))
    out["conv2d_4/conv2d_4/bias:0"] = rng.normal(size=2)
    return {name: value.astype(np.float32) for name, value in out.items()}


def write_weights(path: Path, values: Variables) -> Path:
    """Write variables to an HDF5 file as Keras does; return its path."""
    with h5py.File(path, "w") as file:
        for name, value in values.items():
            file[f"model_weights/{name}"] = value
    return path


def compute_by_hand(values: Variables, image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return outputs (rows, columns, 2) of the network in NumPy, as Keras computes them.

    The image (height, width, 3) has values from -1 to 1.
    """
    x = image
    for k in range(4):
        tail = f"_{k}" if k else ""
        if k:
            x = x.reshape(x.shape[0] // 2, 2, x.shape[1] // 2, 2, -1).max(axis=(1, 3))
        kernel = values[f"conv2d{tail}/conv2d{tail}/kernel:0"]
        padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
        rows, cols = x.shape[:2]
        x = sum(
            padded[i : i + rows, j : j + cols] @ kernel[i, j] for i in range(3) for j in range(3)
        )
        n = {
            name: values[f"batch_normalization{tail}/batch_normalization{tail}/{name}:0"]
            for name in ("gamma", "beta", "moving_mean", "moving_variance")
        }
        x = n["gamma"] * (x - n["moving_mean"]) / np.sqrt(n["moving_variance"] + 1e-3) + n["beta"]
        x = np.maximum(x, 0)
    head: NDArray[np.float64] = x @ values["conv2d_4/conv2d_4/kernel:0"][0, 0]
    return head + values["conv2d_4/conv2d_4/bias:0"]


def test_keras_weights_give_the_outputs_of_keras(tmp_path: Path) -> None:
    values = draw_variables()
    network = load_model(write_weights(tmp_path / "weights.h5", values)).network
    pixels = np.random.default_rng(1).integers(0, 256, (16, 24, 3), np.uint8)
    with torch.no_grad():
        got = network(normalize_images(torch.from_numpy(pixels)[None].permute(0, 3, 1, 2)))[0]
    wanted = compute_by_hand(values, pixels / 128 - 1)
    np.testing.assert_allclose(got.permute(1, 2, 0).numpy(), wanted, rtol=1e-3, atol=1e-2)


def test_a_layer_of_another_shape_is_named_with_both_shapes(tmp_path: Path) -> None:
    values = draw_variables()
    values["conv2d_2/conv2d_2/kernel:0"] = np.zeros((3, 3, 16, 48), np.float32)
    path = write_weights(tmp_path / "weights.h5", values)
    text = r"conv2d_2/kernel has shape \(3, 3, 16, 48\), locanet needs \(3, 3, 16, 32\)"
    with pytest.raises(ModelError, match=text):
        load_keras_weights(path)


def test_a_missing_layer_is_named(tmp_path: Path) -> None:
    values = draw_variables()
    del values["batch_normalization_3/batch_normalization_3/gamma:0"]
    path = write_weights(tmp_path / "weights.h5", values)
    with pytest.raises(ModelError, match="has no batch_normalization_3/gamma"):
        load_keras_weights(path)


def test_file_cut_short_gives_one_line_error(tmp_path: Path) -> None:
    whole = write_weights(tmp_path / "weights.h5", draw_variables()).read_bytes()
    path = tmp_path / "cut.h5"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ModelError, match=r"cut\.h5 cannot be read"):
        load_model(path)


def test_without_h5py_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_weights(tmp_path / "weights.h5", draw_variables())
    monkeypatch.setattr(hdf5_arrays, "find_spec", lambda _: None)
    with pytest.raises(MissingExtra, match=r"pip install 'dmrl\[keras\]'"):
        load_model(path)


@pytest.mark.parametrize("name", ["synthetic.h5", "real.h5"])
def test_published_weights_load(data: Path, name: str) -> None:
    model = load_model(data / "locanet-weights" / name)
    assert model.architecture == "locanet"
    assert model.name == name


@pytest.mark.parametrize("kind", ["soft", "external", "raw file", "virtual"])
def test_external_hdf5_links_are_not_followed(tmp_path: Path, kind: str) -> None:
    """A downloaded weight file must not read the content of other files."""
    ours, key = write_weights(tmp_path / "ours.h5", draw_variables()), "conv2d_4/conv2d_4/bias:0"
    path = write_weights(tmp_path / "w.h5", {k: v for k, v in draw_variables().items() if k != key})
    (tmp_path / "secret.bin").write_bytes(np.ones(2, np.float32).tobytes())
    with h5py.File(path, "a") as file:
        at = f"model_weights/{key}"
        if kind == "soft":
            file[at] = h5py.SoftLink("/model_weights/conv2d/conv2d/kernel:0")
        elif kind == "external":
            file[at] = h5py.ExternalLink(str(ours), at)
        elif kind == "raw file":
            place = [(str(tmp_path / "secret.bin"), 0, 8)]
            file.create_dataset(at, (2,), np.float32, external=place)
        else:
            layout = h5py.VirtualLayout((2,), np.float32)
            layout[:] = h5py.VirtualSource(str(ours), at, (2,))
            file.create_virtual_dataset(at, layout)
    with pytest.raises(ModelError, match=r"has no conv2d_4/bias"):
        load_keras_weights(path)
