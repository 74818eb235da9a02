"""Measure the images per CPU second when building a dataset, and when loading shuffled batches.

    python benchmarks/bench_dataset.py [IMAGES]

dmrl's loader is compared with `datasets` on the same images in the same run: with its torch format
on Array3D and Image columns written by `save_to_disk`, and on dmrl's files. All use one thread. The
files of each leave the page cache before its first pass.

The last table compares first passes with a memory map of the raw images that reads each batch in
file order. Both are opened before the timing and run in turns, with their files out of the page
cache.
"""

import gc
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import datasets
import numpy as np
import torch

from dmrl.datasets import Split, open_dataset
from dmrl.datasets.training_examples import build_examples
from dmrl.images.codec import encode_jpeg
from dmrl.learn.data.batches import collate, epoch_indices
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.stages.dataset import Settings, run
from dmrl.terminal.tables import print_table
from dmrl.topics import CAMERA_IMAGE, LABELS

HEIGHT_PX, WIDTH_PX, BATCH, PASSES, PAIRS = 224, 320, 32, 3, 5
Batches = Callable[[], Iterator[torch.Tensor]]


def write_recording(path: Path, count: int) -> None:
    """Write JPEG images of a smooth ramp with noise, each with a label of one peer."""
    rng = np.random.default_rng(0)
    ramp = np.linspace(0, 200, WIDTH_PX)[None, :, None]
    with RecordingWriter(path, Provenance("bench")) as sink:
        for k in range(count):
            noise = rng.integers(0, 50, (HEIGHT_PX, WIDTH_PX, 3))
            data = encode_jpeg((ramp + noise).astype(np.uint8))
            picture = message_class("CompressedImage")(data=data, format="jpeg")
            peer = {"peer": "cf2", "u_px": 160, "v_px": 112, "depth_m": 1, "source": "truth"}
            sink.write(k * 10**8, CAMERA_IMAGE("cf1"), picture)
            sink.write(k * 10**8, LABELS("cf1"), message_class("PeerLabels")(peers=[peer]))


def iter_shuffled_indices(count: int) -> Iterator[np.ndarray]:
    """Yield shuffled indices, batch by batch; the order is always the same."""
    order = np.random.default_rng(1).permutation(count)
    yield from (order[k : k + BATCH] for k in range(0, count, BATCH))


def from_dmrl(split: Split) -> Iterator[torch.Tensor]:
    """Yield images from the loader of `dmrl train`, which also gathers the labels."""
    examples = build_examples(split)
    chosen = epoch_indices(len(examples), seed=1, epoch=0)
    for start in range(0, len(chosen), BATCH):
        yield collate(examples, chosen[start : start + BATCH]).images


def from_datasets_bytes(split: datasets.Dataset) -> Iterator[torch.Tensor]:
    """Yield images of dmrl's files opened by `datasets`, converted as the dataset card shows."""
    for batch in iter_shuffled_indices(len(split)):
        data = split[batch]["pixels"]
        flat = np.stack([np.frombuffer(item, np.uint8) for item in data])
        yield torch.from_numpy(flat.reshape(-1, HEIGHT_PX, WIDTH_PX, 3))


def from_datasets_torch(split: datasets.Dataset, column: str) -> Iterator[torch.Tensor]:
    """Yield images of a column of `datasets`, which makes the tensors."""
    ready = split.select_columns([column]).with_format("torch", dtype=torch.uint8)
    for batch in iter_shuffled_indices(len(split)):
        yield ready[batch][column]


def save(split: Split, folder: Path, feature: object) -> None:
    """Save the images by `datasets` in a column of this feature type."""
    features = datasets.Features({"image": feature})
    images = [image for block in split.pixels for image in block]
    datasets.Dataset.from_dict({"image": images}, features=features).save_to_disk(str(folder))


def evict(folder: Path) -> None:
    """Drop the data files of a folder from the page cache, unless they are mapped."""
    gc.collect()
    for path in (*folder.rglob("*.arrow"), *folder.rglob("*.bytes")):
        with path.open("rb") as stream:
            os.fsync(stream.fileno())
            os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def sum_bytes(batches: Iterator[torch.Tensor]) -> int:
    """Return the sum of all bytes of all batches, which does not depend on the order of axes."""
    return sum(int(batch.sum(dtype=torch.int64)) for batch in batches)


def read_mb() -> float:
    """Return how much this process has read from disk so far, MB (Linux only)."""
    lines = Path("/proc/self/io").read_text(encoding="utf-8").splitlines()
    return int(next(one for one in lines if one.startswith("read_bytes")).split()[1]) / 1e6


def measure_rates(folder: Path, open_loader: Callable[[], Batches]) -> tuple[int, int, str]:
    """Return the images per CPU second of a pass from disk, and of the pass after it.

    The last value is how much opening the images reads from disk, MB. Everything is repeated
    `PASSES` times. The files leave the page cache before each opening: otherwise the first pass
    looks two to five times as fast. The factor depends on how the files entered the cache, since
    freshly written files are mapped in larger pieces than copied ones.
    """
    spent, images, opened_mb = np.zeros(2), np.zeros(2, int), []
    for _ in range(PASSES):
        batches = None  # else the memory map of the last round would keep its pages in the cache
        evict(folder)
        before_mb = read_mb()
        batches = open_loader()
        opened_mb.append(read_mb() - before_mb)
        for later in (0, 1):
            start = time.process_time()
            images[later] += sum(len(batch) for batch in batches())
            spent[later] += time.process_time() - start
    first, later = images / spent
    return round(first), round(later), f"{np.median(opened_mb):.1f}"


def build(folder: Path, count: int) -> None:
    """Time `dmrl dataset`, including its card and the hashes of its inputs."""
    built = []
    for way in ("raw", "png"):
        start = time.process_time()
        settings = Settings(split="none", png=way == "png")
        run([folder / "flight.mcap"], folder / way, settings)
        built.append((f"dmrl dataset, {way}", round(count / (time.process_time() - start))))
    print_table("building", ("command", "images per cpu-second"), built)


def build_loaders(folder: Path) -> dict[str, Callable[[], Batches]]:
    """Return a function for each loader that opens the images and returns their batches."""
    raw = str(folder / "raw")
    pixels = open_dataset(folder / "raw").split("train")
    shape = (HEIGHT_PX, WIDTH_PX, 3)
    for name, feature in (("a", datasets.Array3D(shape, "uint8")), ("i", datasets.Image())):
        save(pixels, folder / name, feature)

    def ours() -> Batches:
        split = open_dataset(folder / "raw").split("train")
        return lambda: from_dmrl(split)

    def our_bytes() -> Batches:
        split = datasets.load_from_disk(raw, keep_in_memory=False)["train"]
        return lambda: from_datasets_bytes(split)

    def tensors(name: str) -> Batches:
        split = datasets.load_from_disk(str(folder / name), keep_in_memory=False)
        return lambda: from_datasets_torch(split, "image")

    return {
        "dmrl, raw, with grid labels": ours,
        "datasets on our files, bytes": our_bytes,
        "datasets, Array3D, torch format": lambda: tensors("a"),
        "datasets, Image (PNG), torch format": lambda: tensors("i"),
    }


def iter_memory_map(path: Path, count: int) -> Iterator[torch.Tensor]:
    """Yield shuffled batches of a file of raw images; each batch is read in file order.

    The first item is empty: it tells that the file is open.
    """
    images = np.memmap(path, np.uint8, "r", shape=(count, HEIGHT_PX, WIDTH_PX, 3))
    yield torch.empty(0)
    for batch in iter_shuffled_indices(count):
        out = np.empty((len(batch), HEIGHT_PX, WIDTH_PX, 3), np.uint8)
        for place in np.argsort(batch):
            out[place] = images[batch[place]]
        yield torch.from_numpy(out)


def iter_opened_dmrl(folder: Path) -> Iterator[torch.Tensor]:
    """Yield an empty tensor once the dataset is open, then the batches of `from_dmrl`."""
    split = open_dataset(folder / "raw").split("train")
    yield torch.empty(0)
    yield from from_dmrl(split)


def compare_cold(folder: Path, count: int) -> None:
    """Print the CPU and wall time of a memory map's first pass over dmrl's, and the MB read."""
    flat_bytes = folder / "flat.bytes"
    with flat_bytes.open("wb") as flat:
        for batch in from_dmrl(open_dataset(folder / "raw").split("train")):
            flat.write(batch.numpy().tobytes())
    loaders = [lambda: iter_opened_dmrl(folder), lambda: iter_memory_map(flat_bytes, count)]
    spent = np.zeros((PAIRS + 1, 2, 3))  # CPU time, s; wall time, s; MB read
    for turn in range(PAIRS + 1):
        for which in (0, 1) if turn % 2 else (1, 0):
            evict(folder)
            batches = loaders[which]()
            next(batches)
            before = np.array([time.process_time(), time.perf_counter(), read_mb()])
            for batch in batches:
                batch.sum(dtype=torch.int64)
            spent[turn, which] = time.process_time(), time.perf_counter(), read_mb()
            spent[turn, which] -= before
    ratios = spent[1:, 1, :2] / spent[1:, 0, :2]  # the first pair is a warm-up
    rows = [
        (name, *(f"{value:.2f}" for value in (np.median(r), r.min(), r.max())))
        for name, r in zip(("CPU time", "wall time"), ratios.T, strict=True)
    ]
    mb = " and ".join(f"{each:.0f}" for each in np.median(spent[1:, :, 2], axis=0))
    title = f"rate from disk over that of a memory map, {PAIRS} pairs; {mb} MB read"
    print_table(title, ("measured by", "median", "min", "max"), rows)


def main() -> None:
    """Print the tables."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1024
    torch.set_num_threads(1)
    datasets.disable_progress_bars()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_recording(folder / "flight.mcap", count)
        build(folder, count)
        loaders = build_loaders(folder)
        # This pass also does the lazy imports, which would slow the first timed pass.
        sums = {name: sum_bytes(open_loader()()) for name, open_loader in loaders.items()}
        if len(set(sums.values())) != 1:
            raise SystemExit(f"the loaders gave different images: {sums}")
        rows = [(name, *measure_rates(folder, one)) for name, one in loaders.items()]
        title = "loading, images per cpu-second; all loaders gave the same bytes"
        print_table(title, ("loader", "from disk", "second pass", "MB read to open"), rows)
        compare_cold(folder, count)


if __name__ == "__main__":
    main()
