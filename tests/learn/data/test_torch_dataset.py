"""Rows as batches of torch tensors, and their division among processes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dmrl.errors import SettingError
from dmrl.learn.data.torch_dataset import ProcessSampler, TorchRows, get_torchrun_rank, loader_of


class Rows:
    """A table whose images and numbers encode the row."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    def gathered(self, rows: Sequence[int], /) -> dict[str, NDArray[Any]]:
        """Return images (n, 4, 6, 3) and numbers (n,) of rows."""
        number = np.array(rows)
        image = np.zeros((len(rows), 4, 6, 3), np.uint8)
        image[:, 1, 2, :] = number[:, None] + np.array([0, 50, 100])
        return {"image": image, "number": number}


@pytest.mark.parametrize(
    ("number", "parts", "there"), [(0, 1, 1), (1, 2, 1), (2, 2, 0), (-1, 2, 0)]
)
def test_parts_count_from_0(number: int, parts: int, there: int) -> None:
    if there:
        assert ProcessSampler(5, (number, parts), shuffle=False, seed=0).number == number
        return
    with pytest.raises(SettingError, match=f"no process {number} of {parts}"):
        ProcessSampler(5, (number, parts), shuffle=False, seed=0)


@pytest.mark.parametrize("parts", [1, 3, 4])
def test_in_order_each_row_is_read_once(parts: int) -> None:
    mine = [ProcessSampler(10, (k, parts), shuffle=False, seed=0) for k in range(parts)]
    assert [row for part in mine for row in part] == list(range(10))
    assert [len(part) for part in mine] == [len(list(part)) for part in mine]
    assert max(map(len, mine)) - min(map(len, mine)) <= 1


def test_shuffled_parts_are_equal_and_disjoint() -> None:
    mine = [ProcessSampler(10, (k, 3), shuffle=True, seed=1) for k in range(3)]
    first, second = ([list(part) for part in mine] for _ in range(2))
    for read in (first, second):
        rows = [row for part in read for row in part]
        assert len(set(rows)) == len(rows) == 9
        assert {len(part) for part in read} == {3}
    assert first != second and len(mine[0]) == 3
    again = ProcessSampler(10, (0, 3), shuffle=True, seed=1)
    assert list(again) == first[0] and list(again) == second[0]
    assert list(ProcessSampler(10, (0, 3), shuffle=True, seed=2)) != first[0]


def test_images_are_channels_first_in_batches_and_in_single_rows() -> None:
    rows = TorchRows(Rows(7))
    assert len(rows) == 7
    batch = rows.get_batch([5, 3])
    assert batch["image"].shape == (2, 3, 4, 6) and batch["image"].dtype == torch.uint8
    assert batch["image"][:, :, 1, 2].tolist() == [[5, 55, 105], [3, 53, 103]]
    assert batch["number"].tolist() == [5, 3]
    one = rows[4]
    assert one["image"].shape == (3, 4, 6) and one["number"] == 4


@pytest.mark.parametrize("shuffle", [False, True])
def test_a_loader_gives_batches_of_its_part(shuffle: bool) -> None:
    def read(**more: Any) -> list[list[int]]:
        loader = loader_of(Rows(10), 4, shuffle=shuffle, seed=3, workers=0, **more)
        return [batch["number"].tolist() for batch in loader]

    whole = read(part=(0, 1))
    assert [len(batch) for batch in whole] == [4, 4, 2]
    assert ([row for batch in whole for row in batch] == list(range(10))) != shuffle
    assert [len(batch) for batch in read(part=(1, 2))] == [4, 1]
    assert read(part=None) == whole  # Without torchrun there is one part.


def test_rank_and_world_size_are_read_from_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RANK", raising=False)
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert get_torchrun_rank() == (0, 1)
    monkeypatch.setenv("RANK", "2")
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert get_torchrun_rank() == (2, 4)
    monkeypatch.setenv("RANK", "x")
    with pytest.raises(SettingError, match="RANK and WORLD_SIZE are no numbers"):
        get_torchrun_rank()
