"""Integer networks written to and read from disk."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.deploy.int8 import reference
from dmrl.deploy.int8.store import INTEGER_NAME, load_network, save_network
from dmrl.deploy.samples import SAMPLES_NAME, load_samples, save_samples
from dmrl.errors import ModelError

from ..graphs import quantised_network
from ..networks import random_network


@pytest.mark.parametrize("seed", [0, 3, 8])
def test_integer_network_round_trips(seed: int, tmp_path: Path) -> None:
    network = random_network(seed)
    save_network(network, tmp_path / INTEGER_NAME)
    again = load_network(tmp_path)
    image = np.random.default_rng(0).integers(0, 256, (*network.shapes[0][1:], network.channels))
    wanted = reference.run_network(network, image.astype(np.uint8))
    got = reference.run_network(again, image.astype(np.uint8))
    for name, grid in wanted.items():
        np.testing.assert_array_equal(got[name], grid)
    save_network(again, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / INTEGER_NAME).read_bytes()


def test_missing_network_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"no integer.npz in .*Make one with: dmrl quantize"):
        load_network(tmp_path)


@pytest.mark.parametrize("kept", [0, 1, 100, 3000])
def test_truncated_network_file_is_reported(kept: int, tmp_path: Path) -> None:
    file = tmp_path / INTEGER_NAME
    save_network(quantised_network(0), file)
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(ModelError, match=r"integer.npz is damaged"):
        load_network(file)


def test_pickled_arrays_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / INTEGER_NAME, description=np.array([{"format": 1}], object))
    with pytest.raises(ModelError, match="damaged"):
        load_network(tmp_path)


def test_sample_images_round_trip(tmp_path: Path) -> None:
    images = np.random.default_rng(0).integers(0, 256, (2, 8, 16, 3)).astype(np.uint8)
    save_samples(images, tmp_path)
    np.testing.assert_array_equal(load_samples(tmp_path), images)
    (tmp_path / SAMPLES_NAME).write_bytes(b"PK")
    with pytest.raises(ModelError, match="damaged"):
        load_samples(tmp_path)
    with pytest.raises(ModelError, match=r"no .*samples\.npz"):
        load_samples(tmp_path / "nowhere")
