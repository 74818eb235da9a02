"""Datasets read over HTTP, in parts of an epoch, and by several processes of torchrun."""

import functools
import json
import subprocess
import sys
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler
from pathlib import Path

import numpy as np
import pytest
from datasets import load_dataset

import dmrl
from dmrl.datasets import open_dataset
from dmrl.errors import SettingError
from dmrl.learn.data import batches
from dmrl.learn.data.torch_dataset import ProcessSampler
from dmrl.stages.dataset import Settings, add, run

from ..local_server import serve_locally
from .conftest import Record


class QuietFileHandler(SimpleHTTPRequestHandler):
    """Serves the files of a folder as `python -m http.server` does, without a log."""

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture
def server_url(tmp_path: Path) -> Iterator[str]:
    """Serve the test's folder over HTTP and return the address."""
    handler = functools.partial(QuietFileHandler, directory=str(tmp_path))
    with serve_locally(handler) as port:
        yield f"http://127.0.0.1:{port}"


def build_extended_dataset(record: Record, out: Path, *, parquet: bool = False) -> Path:
    """Build a dataset of 12 images and append 6; it has five shards."""
    flights = [record(f"{k}.mcap", seed=k, begin_ns=k * 10**10) for k in range(3)]
    run(flights[:2], out, Settings(split="none", shard_images=4, parquet=parquet))
    add(flights[2:], out, Settings())
    return out


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["parquet", "arrow"])
def test_datasets_streams_it_from_a_file_server(
    record: Record, tmp_path: Path, server_url: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datasets.config.HF_CACHE_HOME", str(tmp_path / "cache"))
    out = build_extended_dataset(record, tmp_path / "set", parquet=kind == "parquet")
    names, place = {"parquet": ("train-*", "data"), "arrow": ("data-*", "train")}[kind]
    (split,) = json.loads((out / "manifest.json").read_text())["splits"]
    listed = [f"{server_url}/set/{place}/{shard['file']}" for shard in split["shards"]]
    for files in (listed, f"{server_url}/set/{place}/{names}.{kind}"):
        rows = list(load_dataset(kind, data_files={"train": files}, streaming=True)["train"])
        assert [row["source"] for row in rows] == ["0.mcap"] * 6 + ["1.mcap"] * 6 + ["2.mcap"] * 6
        here = list(open_dataset(out).split("train").images(range(18)))
        if kind == "arrow":
            assert all(row["pixels"] == rgb.tobytes() for row, rgb in zip(rows, here, strict=True))
        else:
            shown = (np.asarray(row["image"]) for row in rows)
            assert all(np.array_equal(a, b) for a, b in zip(shown, here, strict=True))


def test_parts_of_an_epoch_are_disjoint_and_equally_long() -> None:
    for count in (1, 7, 100, 3 * batches.SHUFFLE_WINDOW_IMAGES + 17):
        parts = [ProcessSampler(count, (k, 3), shuffle=True, seed=5) for k in range(3)]
        first, second = ([list(part) for part in parts] for _ in range(2))
        assert [len(one) for one in first] == [count // 3] * 3 == [len(p) for p in parts]
        assert len({row for one in first for row in one}) == count // 3 * 3
        assert first != second or count < 7
        whole = [
            row for k in range(3) for row in ProcessSampler(count, (k, 3), shuffle=False, seed=0)
        ]
        assert whole == list(range(count))
    with pytest.raises(SettingError, match="no process 3 of 3"):
        ProcessSampler(9, (3, 3), shuffle=True, seed=0)


def test_a_large_split_is_shuffled_in_windows_of_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "SHUFFLE_WINDOW_IMAGES", 640)
    rows = batches.epoch_indices(10_007, seed=1, epoch=2)
    assert sorted(rows.tolist()) == list(range(10_007))
    for start in range(0, 10_007, 640):
        assert (
            len({row // batches.SHUFFLE_BLOCK_IMAGES for row in rows[start : start + 640].tolist()})
            <= 12
        )
    assert not np.array_equal(rows, batches.epoch_indices(10_007, seed=1, epoch=3))
    assert np.array_equal(rows, batches.epoch_indices(10_007, seed=1, epoch=2))
    # Blocks come from the whole split, and the images of a window are shuffled.
    assert np.ptp(rows[:640]) > 5_000 and (np.diff(rows[:640]) < 0).sum() > 200


@pytest.mark.heavy
def test_batch_decodes_only_its_own_images(
    record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = dmrl.dataset(build_extended_dataset(record, tmp_path / "set", parquet=True))["train"]
    whole = list(open_dataset(tmp_path / "set").split("train").pixels)
    decoded: list[str] = []
    real = dmrl.datasets.packed_images.decode
    monkeypatch.setattr(
        "dmrl.datasets.packed_images.decode",
        lambda data, what: (decoded.append(what), real(data, what))[1],
    )
    batch = next(iter(rows.loader(3, shuffle=True, seed=2)))
    assert len(decoded) == 3
    first = batches.epoch_indices(18, seed=2, epoch=0)[:3]
    shown = np.concatenate(whole)[first].transpose(0, 3, 1, 2)
    assert np.array_equal(batch["image"].numpy(), shown)
    assert np.array_equal(batch["depth"].numpy(), rows.depth[first])


TRAINING = """
import sys
from pathlib import Path

import torch.distributed as group

import dmrl

group.init_process_group("gloo")
rows = dmrl.dataset(sys.argv[1])["train"]
loader = rows.loader(2, shuffle=True)
for epoch in range(2):
    seen = [int(image.sum()) for batch in loader for image in batch["image"]]
    Path(sys.argv[2], f"{epoch}-{group.get_rank()}").write_text(" ".join(map(str, seen)))
group.destroy_process_group()
"""


@pytest.mark.slow
def test_two_processes_of_torchrun_read_disjoint_parts(record: Record, tmp_path: Path) -> None:
    out, script, said = (
        build_extended_dataset(record, tmp_path / "set"),
        tmp_path / "read.py",
        tmp_path / "said",
    )
    script.write_text(TRAINING)
    said.mkdir()
    words = ["--nproc-per-node", "2", "--master-addr", "127.0.0.1", "--rdzv-backend", "c10d"]
    words += ["--rdzv-endpoint", "127.0.0.1:0", str(script), str(out), str(said)]
    subprocess.run([sys.executable, "-m", "torch.distributed.run", *words], check=True, timeout=120)
    every = {int(image.sum()) for image in open_dataset(out).split("train").images(range(18))}
    assert len(every) == 18
    for epoch in range(2):
        one, two = (set((said / f"{epoch}-{k}").read_text().split()) for k in range(2))
        assert len(one) == len(two) == 9 and not one & two
        assert {int(value) for value in one | two} == every
