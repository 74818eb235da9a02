"""Loader alone, and training with loading against the same step on data already in memory.

    python benchmarks/bench_training.py [IMAGES] [--batch-size 5] [--threads 2]

The two ways of training take turns, a few steps each, on the same network and optimizer, so
that other load on the machine falls on both. The images come from a dataset on disk, a fresh
epoch each time; "in memory" reuses one gathered batch.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from dmrl.dataset import open_dataset
from dmrl.images import encode_png
from dmrl.learn.batches import Batch, Examples, shuffled
from dmrl.learn.fit import FitSettings, new_network, train_step
from dmrl.messages import message
from dmrl.recording import Provenance, RecordingWriter
from dmrl.stages.dataset import Settings, run
from dmrl.tables import print_table
from dmrl.topics import camera_image, labels

HEIGHT_PX, WIDTH_PX = 224, 320
STEPS, TURNS = 10, 30


def build(folder: Path, count: int) -> Examples:
    """A dataset of smooth pictures, one peer each, opened as training opens it."""
    ramp = np.linspace(0, 200, WIDTH_PX)[None, :, None] + np.zeros((HEIGHT_PX, 1, 3))
    with RecordingWriter(folder / "flight.mcap", Provenance("bench")) as sink:
        for k in range(count):
            data = encode_png((ramp + k % 50).astype(np.uint8))
            picture = message("CompressedImage")(data=data, format="png")
            peer = {"peer": "cf2", "u_px": k % 320, "v_px": 112, "depth_m": 1, "source": "truth"}
            sink.write(k * 10**8, camera_image("cf1"), picture)
            sink.write(k * 10**8, labels("cf1"), message("PeerLabels")(peers=[peer]))
    run([folder / "flight.mcap"], folder / "dataset", Settings(split="none"))
    split = open_dataset(folder / "dataset").split("train")
    return Examples(split.pixels, split.confidence, split.depth)


def loader_rate(examples: Examples, batch_size: int) -> float:
    """Images per cpu-second, gathered into batches, after a first pass."""
    rates = []
    for epoch in range(6):
        begun = time.process_time()
        for _ in shuffled(examples, batch_size, seed=0, epoch=epoch):
            pass
        rates.append(len(examples) / (time.process_time() - begun))
    return float(np.median(rates[1:]))


def endless(examples: Examples, batch_size: int) -> Iterator[Batch]:
    """Whole batches, epoch after epoch."""
    epoch = 0
    while True:
        for batch in shuffled(examples, batch_size, seed=0, epoch=epoch):
            if len(batch.images) == batch_size:
                yield batch
        epoch += 1


def step_times(examples: Examples, batch_size: int) -> tuple[float, float, float]:
    """CPU seconds per step with loading and in memory, and the ratio, taken in turns.

    The ratio is the median of the turns' ratios, so that a slow turn weighs on both sides.
    """
    settings = FitSettings(batch_size=batch_size, device="cpu")
    network = new_network(settings, examples).train()
    optimizer = torch.optim.Adam(network.parameters())
    loading = endless(examples, batch_size)
    ready = Batch(*(tensor.clone() for tensor in next(loading)))
    spent: dict[str, list[float]] = {"loading": [], "ready": []}
    for turn in range(TURNS + 1):
        for name in sorted(spent, reverse=bool(turn % 2)):
            batches = islice(loading, STEPS) if name == "loading" else iter([ready] * STEPS)
            begun = time.process_time()
            for batch in batches:
                train_step(network, optimizer, batch, settings, 1e-4)
            spent[name].append((time.process_time() - begun) / STEPS)
    # The first turn warms up.
    loaded, in_memory = (np.array(spent[name][1:]) for name in ("loading", "ready"))
    return (
        float(np.median(loaded)),
        float(np.median(in_memory)),
        float(np.median(in_memory / loaded)),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("images", type=int, nargs="?", default=512)
    parser.add_argument("--batch-size", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    with tempfile.TemporaryDirectory() as name:
        examples = build(Path(name), args.images)
        rate = loader_rate(examples, args.batch_size)
        loaded, ready, ratio = step_times(examples, args.batch_size)
    rows = [
        ("loader alone, images per cpu-second", round(rate)),
        ("training with loading, images per cpu-second", round(args.batch_size / loaded, 1)),
        ("training in memory, images per cpu-second", round(args.batch_size / ready, 1)),
        ("with loading / in memory", round(ratio, 3)),
    ]
    title = f"{args.images} images, batches of {args.batch_size}, {args.threads} threads"
    print_table(title, ("what", "value"), rows)


if __name__ == "__main__":
    main()
