"""The Python interface to datasets: arrays, images, and batches for torch."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import dmrl
from dmrl.datasets import open_dataset
from dmrl.errors import DatasetError, MissingSplit, SettingError


@pytest.mark.heavy
def test_dataset_rows_equal_arrays_of_the_split(data: Path) -> None:
    found = dmrl.dataset(data)
    split = open_dataset(data).split("train")
    rows = found["train"]
    assert set(found) == set(open_dataset(data).splits) and len(rows) == len(split)
    every = list(split.images(range(len(split))))
    assert np.array_equal(rows[1]["image"], every[1])
    assert np.array_equal(rows[-1]["image"], every[-1])
    assert np.array_equal(rows[1]["depth"], split.depth[1])
    with pytest.raises(IndexError):
        rows[len(rows)]
    assert np.array_equal(rows[1:3]["image"], np.stack(every[1:3]))
    assert rows._repr_html_().count("<img") == min(len(rows), 6)


@pytest.mark.heavy
def test_data_frame_has_the_peers(data: Path) -> None:
    rows = dmrl.dataset(data)["train"]
    frame = rows.to_pandas()
    peers = [p["u_px"] for row in rows.to_arrow()["peers"].to_pylist() for p in row]
    assert frame["u_px"].dropna().tolist() == peers and "pixels" not in frame.columns
    assert frame.columns.is_unique and set(frame["source"]) == {"flight.mcap"}
    assert set(frame["label_source"].dropna()) == {"truth"}


@pytest.mark.heavy
def test_loader_batches_equal_single_rows(data: Path) -> None:
    rows = dmrl.dataset(data)["train"]
    batches = list(rows.loader(4))
    images = torch.cat([batch["image"] for batch in batches])
    assert images.shape[1] == 3 and images.dtype == torch.uint8
    single = np.stack([row["image"] for row in rows]).transpose(0, 3, 1, 2)
    assert np.array_equal(images.numpy(), single)
    plain = next(iter(DataLoader(rows, batch_size=4)))  # type: ignore[arg-type]
    assert np.array_equal(plain["depth"].numpy(), batches[0]["depth"].numpy())
    assert torch.equal(rows.torch()[2]["image"], images[2])


def test_shuffling_depends_on_the_seed_alone_and_loses_nothing(data: Path) -> None:
    rows = dmrl.dataset(data)["train"]

    def order(seed: int) -> list[float]:
        loader = rows.loader(3, shuffle=True, seed=seed)
        return [float(image.float().mean()) for batch in loader for image in batch["image"]]

    assert order(1) == order(1) != order(2)
    assert sorted(order(1)) == sorted(order(2))


def test_missing_dataset_or_split_is_reported(data: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="dmrl dataset"):
        dmrl.dataset(tmp_path)
    with pytest.raises(MissingSplit, match=r"^no split val in .*\. It has: train"):
        dmrl.dataset(data)["val"]
    assert "train" in dmrl.dataset(data)._repr_html_()
    assert dmrl.dataset(data).card().startswith("---")


def test_empty_choices_of_rows_are_allowed_and_invalid_ones_refused(data: Path) -> None:
    rows = dmrl.dataset(data)["train"]
    assert rows[5:5]["image"].shape == (0, 224, 320, 3)
    assert rows.gathered([])["depth"].shape == (0, 28, 40)
    for odd in ([True, False], [0.7], [[0]], ["image"]):
        with pytest.raises(IndexError, match="rows are whole numbers"):
            rows.gathered(odd)  # type: ignore[arg-type]
    for settings in ({"batch_size": 0}, {"workers": -1}, {"seed": -1}):
        with pytest.raises(SettingError, match=r"Give .* or more"):
            rows.loader(**settings)
