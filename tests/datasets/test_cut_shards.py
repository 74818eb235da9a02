"""Reading a shard that is truncated while mapped gives a one-line error that names it."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dmrl
from dmrl.datasets import open_dataset
from dmrl.datasets.training_examples import build_examples
from dmrl.errors import DatasetError
from dmrl.learn.data.augment import Augmentation, Augmenter
from dmrl.learn.data.batches import collate
from dmrl.stages.dataset import Settings, run

from .conftest import Record

pytestmark = pytest.mark.heavy

MESSAGE = r"shard .*train/data-0000\d-of-00002\.arrow was cut short while it was read"


@pytest.fixture
def dataset(record: Record, tmp_path: Path) -> Path:
    """Build a dataset of two shards."""
    run([record(), record("other.mcap", seed=1)], tmp_path / "out", Settings(shard_images=4))
    return tmp_path / "out"


def truncate_shard(folder: Path, number: int = 1) -> Path:
    """Truncate a shard of the train split after its schema; return its path."""
    shard = sorted((folder / "train").glob("*.arrow"))[number]
    os.truncate(shard, 1000)
    return shard


def test_row_of_a_truncated_shard_gives_an_error(dataset: Path) -> None:
    rows = dmrl.dataset(dataset)["train"]
    assert rows[0]["image"].any()
    truncate_shard(dataset)
    with pytest.raises(DatasetError, match=MESSAGE):
        rows[5]


@pytest.mark.parametrize("augmented", [False, True])
def test_training_batch_of_a_truncated_shard_gives_an_error(dataset: Path, augmented: bool) -> None:
    examples = build_examples(open_dataset(dataset).split("train"))
    augmenter = Augmenter(examples, Augmentation(), seed=0)
    truncate_shard(dataset, 0)
    with pytest.raises(DatasetError, match=MESSAGE):
        augmenter.augment_batch([0], epoch=0, index=0) if augmented else collate(examples, [0])


def test_replaced_shard_is_read_from_the_old_mapping(dataset: Path) -> None:
    """The mapping keeps the deleted file, so its rows stay readable."""
    rows = dmrl.dataset(dataset)["train"]
    before = rows[5]["image"]
    shard = sorted((dataset / "train").glob("*.arrow"))[1]
    shard.unlink()
    shard.write_bytes(b"another file")
    assert np.array_equal(rows[5]["image"], before)


@pytest.mark.skipif(sys.platform != "linux", reason="asks for SIGBUS")
def test_shard_truncated_during_a_read_gives_one_line_error(dataset: Path) -> None:
    code = """
import os, sys
from pathlib import Path
import numpy as np
from dmrl.datasets import open_dataset
pixels = open_dataset(Path(sys.argv[1])).split("train").pixels
os.truncate(sys.argv[2], 1000)
print(sum(int(np.asarray(part).sum()) for part in pixels))
"""
    shard = sorted((dataset / "train").glob("*.arrow"))[1]
    words = [sys.executable, "-c", code, str(dataset), str(shard)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done
    assert done.stderr == (
        f"dmrl: shard {shard} was cut short while it was read. Make the dataset again, or copy it "
        "whole\n"
    )
    assert done.stdout == ""
