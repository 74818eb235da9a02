"""Images per cpu-second: building a dataset, and gathering shuffled batches from it into torch.

    python benchmarks/bench_dataset.py [IMAGES]

Peers, in the same run on the same images: `datasets` with its torch format on its own Array3D
and Image columns, as `save_to_disk` writes them, and `datasets` on our files. The page cache
is dropped before the first pass of each. One thread.

The last table compares first passes with a memory map of the images' bytes, of which each batch is
read in the order of the file: pairs in turn, both opened beforehand, files of either out of the
page cache.
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
    """Write smooth pictures with noise, as JPEG, one peer each."""
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


def order_of(count: int) -> Iterator[np.ndarray]:
    """Yield shuffled indices, batch by batch."""
    order = np.random.default_rng(1).permutation(count)
    yield from (order[k : k + BATCH] for k in range(0, count, BATCH))


def from_dmrl(split: Split) -> Iterator[torch.Tensor]:
    """Yield images from the loader of `dmrl train`, which gathers the robots as well."""
    examples = build_examples(split)
    chosen = epoch_indices(len(examples), seed=1, epoch=0)
    for start in range(0, len(chosen), BATCH):
        yield collate(examples, chosen[start : start + BATCH]).images


def from_datasets_bytes(split: datasets.Dataset) -> Iterator[torch.Tensor]:
    """Our files, opened by `datasets`: bytes to arrays by hand, as the card shows."""
    for batch in order_of(len(split)):
        data = split[batch]["pixels"]
        flat = np.stack([np.frombuffer(item, np.uint8) for item in data])
        yield torch.from_numpy(flat.reshape(-1, HEIGHT_PX, WIDTH_PX, 3))


def from_datasets_torch(split: datasets.Dataset, column: str) -> Iterator[torch.Tensor]:
    """Let `datasets` make the tensors."""
    ready = split.select_columns([column]).with_format("torch", dtype=torch.uint8)
    for batch in order_of(len(split)):
        yield ready[batch][column]


def save(split: Split, folder: Path, feature: object) -> None:
    """Save the same images in a column of `datasets`' own, by its own means."""
    features = datasets.Features({"image": feature})
    images = [image for block in split.pixels for image in block]
    datasets.Dataset.from_dict({"image": images}, features=features).save_to_disk(str(folder))


def evict(folder: Path) -> None:
    """Drop every file of a folder from the page cache, which keeps what is mapped."""
    gc.collect()
    for path in (*folder.rglob("*.arrow"), *folder.rglob("*.bytes")):
        with path.open("rb") as stream:
            os.fsync(stream.fileno())
            os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def content_sum(batches: Iterator[torch.Tensor]) -> int:
    """Sum of every byte of every batch, whatever the order of the axes."""
    return sum(int(batch.sum(dtype=torch.int64)) for batch in batches)


def read_mb() -> float:
    """MB that this process has read from disk so far; Linux counts them."""
    lines = Path("/proc/self/io").read_text(encoding="utf-8").splitlines()
    return int(next(one for one in lines if one.startswith("read_bytes")).split()[1]) / 1e6


def rates(folder: Path, open_way: Callable[[], Batches]) -> tuple[int, int, str]:
    """Images per cpu-second of a pass from disk and of the pass after it, over `PASSES` openings.

    The last value is what an opening reads from disk, MB.

    The files leave the page cache before each opening. Without that the first pass looks two to
    five times as fast, depending on how the files came into the cache: freshly written ones
    are mapped in larger pieces than those that were copied or read back.
    """
    spent, images, opened_mb = np.zeros(2), np.zeros(2, int), []
    for _ in range(PASSES):
        batches = None  # or the map of the round before keeps its pages
        evict(folder)
        before_mb = read_mb()
        batches = open_way()
        opened_mb.append(read_mb() - before_mb)
        for later in (0, 1):
            start = time.process_time()
            images[later] += sum(len(batch) for batch in batches())
            spent[later] += time.process_time() - start
    first, later = images / spent
    return round(first), round(later), f"{np.median(opened_mb):.1f}"


def build(folder: Path, count: int) -> None:
    """Time `dmrl dataset`, card and hashing of the inputs included."""
    built = []
    for way in ("raw", "png"):
        start = time.process_time()
        settings = Settings(split="none", png=way == "png")
        run([folder / "flight.mcap"], folder / way, settings)
        built.append((f"dmrl dataset, {way}", round(count / (time.process_time() - start))))
    print_table("build", ("way", "images per cpu-second"), built)


def ways_of(folder: Path) -> dict[str, Callable[[], Batches]]:
    """Return a function for each loader that opens the images again."""
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


def sorted_map(path: Path, count: int) -> Iterator[torch.Tensor]:
    """Yield shuffled batches of a file of raw images, each read in the order of the file."""
    images = np.memmap(path, np.uint8, "r", shape=(count, HEIGHT_PX, WIDTH_PX, 3))
    yield torch.empty(0)
    for batch in order_of(count):
        out = np.empty((len(batch), HEIGHT_PX, WIDTH_PX, 3), np.uint8)
        for place in np.argsort(batch):
            out[place] = images[batch[place]]
        yield torch.from_numpy(out)


def opened_dmrl(folder: Path) -> Iterator[torch.Tensor]:
    """Yield nothing once the dataset is open, then the batches of `from_dmrl`."""
    split = open_dataset(folder / "raw").split("train")
    yield torch.empty(0)
    yield from from_dmrl(split)


def compare_cold(folder: Path, count: int) -> None:
    """Print CPU and wall time of first passes over a sorted map's, and what they read."""
    with (folder / "flat.bytes").open("wb") as flat:
        for batch in from_dmrl(open_dataset(folder / "raw").split("train")):
            flat.write(batch.numpy().tobytes())
    loaders = [lambda: opened_dmrl(folder), lambda: sorted_map(folder / "flat.bytes", count)]
    spent = np.zeros((PAIRS + 1, 2, 3))  # CPU-s, s, MB
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
    ratios = spent[1:, 1, :2] / spent[1:, 0, :2]  # the first pair warms up
    rows = [
        (name, *(f"{value:.2f}" for value in (np.median(r), r.min(), r.max())))
        for name, r in zip(("CPU time", "wall time"), ratios.T, strict=True)
    ]
    mb = " and ".join(f"{each:.0f}" for each in np.median(spent[1:, :, 2], axis=0))
    title = f"rate from disk over that of a sorted map, {PAIRS} pairs; {mb} MB read"
    print_table(title, ("by", "median", "least", "most"), rows)


def main() -> None:
    """Print the tables."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1024
    torch.set_num_threads(1)
    datasets.disable_progress_bars()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_recording(folder / "flight.mcap", count)
        build(folder, count)
        ways = ways_of(folder)
        # Also brings lazy imports and the page cache to where they are in a long run.
        sums = {way: content_sum(open_way()()) for way, open_way in ways.items()}
        if len(set(sums.values())) != 1:
            raise SystemExit(f"the ways gave different images: {sums}")
        rows = [(way, *rates(folder, open_way)) for way, open_way in ways.items()]
        title = "load, images per cpu-second; every way gave the same bytes"
        print_table(title, ("way", "from disk", "pass after it", "MB read to open"), rows)
        compare_cold(folder, count)


if __name__ == "__main__":
    main()
