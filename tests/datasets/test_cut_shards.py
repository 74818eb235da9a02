"""Shards truncated while they are mapped: the reader ends with one line that names the shard."""

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

CUT = r"shard .*train/data-0000\d-of-00002\.arrow was cut short while it was read"


@pytest.fixture
def built(record: Record, tmp_path: Path) -> Path:
    run([record(), record("other.mcap", seed=1)], tmp_path / "out", Settings(shard_images=4))
    return tmp_path / "out"


def cut(folder: Path, number: int = 1) -> Path:
    """Cut a shard of the train split behind its schema; return its path."""
    shard = sorted((folder / "train").glob("*.arrow"))[number]
    os.truncate(shard, 1000)
    return shard


def test_rows_in_python(built: Path) -> None:
    rows = dmrl.dataset(built)["train"]
    assert rows[0]["image"].any()
    cut(built)
    with pytest.raises(DatasetError, match=CUT):
        rows[5]


@pytest.mark.parametrize("augmented", [False, True])
def test_batches_of_a_training(built: Path, augmented: bool) -> None:
    examples = build_examples(open_dataset(built).split("train"))
    augmenter = Augmenter(examples, Augmentation(), seed=0)
    cut(built, 0)
    with pytest.raises(DatasetError, match=CUT):
        augmenter.augment_batch([0], epoch=0, index=0) if augmented else collate(examples, [0])


def test_replaced_shard_is_read_from_the_old_mapping(built: Path) -> None:
    """The mapping keeps the old file: nothing is cut."""
    rows = dmrl.dataset(built)["train"]
    before = rows[5]["image"]
    shard = sorted((built / "train").glob("*.arrow"))[1]
    shard.unlink()
    shard.write_bytes(b"another file")
    assert np.array_equal(rows[5]["image"], before)


@pytest.mark.skipif(sys.platform != "linux", reason="asks for SIGBUS")
def test_shard_truncated_during_a_read_gives_one_line_error(built: Path) -> None:
    code = """
import os, sys
from pathlib import Path
import numpy as np
from dmrl.datasets import open_dataset
pixels = open_dataset(Path(sys.argv[1])).split("train").pixels
os.truncate(sys.argv[2], 1000)
print(sum(int(np.asarray(part).sum()) for part in pixels))
"""
    shard = sorted((built / "train").glob("*.arrow"))[1]
    words = [sys.executable, "-c", code, str(built), str(shard)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done
    assert done.stderr == (
        f"dmrl: shard {shard} was cut short while it was read. Make the dataset again, or copy it "
        "whole\n"
    )
    assert done.stdout == ""
