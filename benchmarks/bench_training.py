"""Measure the images per CPU second of loading, augmentation and training steps.

    python benchmarks/bench_training.py [IMAGES] [--recipe published_best] [--threads 1]

The variants take turns, a few steps each, so that other load on the machine slows all of them
alike: dmrl's network on newly augmented batches and on one batch in memory, that network with
torch's own backward pass of depthwise layers, in float32, and the published network.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from dmrl import recipe
from dmrl.datasets import open_dataset
from dmrl.datasets.training_examples import build_examples
from dmrl.guards.memory import keep_freed_memory
from dmrl.images.codec import encode_png
from dmrl.learn.data.augment import Augmenter
from dmrl.learn.data.batches import Batch, ExampleSet, collate, epoch_indices
from dmrl.learn.networks.depthwise import DepthwiseConv
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.optimizer import build_optimizer
from dmrl.learn.training.train_step import train_step
from dmrl.learn.training.trainer import build_initial_network
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.stages.dataset import Settings, run
from dmrl.terminal.tables import print_table
from dmrl.topics import CAMERA_IMAGE, LABELS

HEIGHT_PX, WIDTH_PX = 224, 320
STEPS, TURNS = 3, 8


def build(folder: Path, count: int) -> ExampleSet:
    """Make a dataset of smooth images with one peer each, and open it like the training."""
    ramp = np.linspace(0, 200, WIDTH_PX)[None, :, None] + np.zeros((HEIGHT_PX, 1, 3))
    with RecordingWriter(folder / "flight.mcap", Provenance("bench")) as sink:
        for k in range(count):
            data = encode_png((ramp + k % 50).astype(np.uint8))
            picture = message_class("CompressedImage")(data=data, format="png")
            u_px = 40 + k % 240
            peer = {"peer": "cf2", "u_px": u_px, "v_px": 112, "depth_m": 1, "source": "truth"}
            peer["box_px"] = [u_px - 20, 102, u_px + 20, 122]
            sink.write(k * 10**8, CAMERA_IMAGE("cf1"), picture)
            sink.write(k * 10**8, LABELS("cf1"), message_class("PeerLabels")(peers=[peer]))
    run([folder / "flight.mcap"], folder / "dataset", Settings(split="none"))
    return build_examples(open_dataset(folder / "dataset").split("train"))


def iter_batches(examples: ExampleSet, settings: TrainConfig) -> Iterator[Batch]:
    """Yield full augmented batches without end, epoch after epoch."""
    augmenter, size, epoch = Augmenter(examples, settings.augmentation(0), seed=0), 0, 0
    size = settings.batch_size
    while True:
        chosen = epoch_indices(len(examples), seed=0, epoch=epoch)
        for index in range(len(chosen) // size):
            part = chosen[index * size : (index + 1) * size]
            yield augmenter.augment_batch(part, epoch=epoch, index=index)
        epoch += 1


def build_steps(examples: ExampleSet, settings: TrainConfig) -> dict[str, Callable[[], object]]:
    """Return a function for each variant that does one step, by name."""
    fresh = iter_batches(examples, settings)
    ready = next(fresh)
    chosen = epoch_indices(len(examples), seed=0, epoch=0)[: settings.batch_size]

    def build_step(change: dict[str, object], batches: Iterator[Batch] | None = None) -> object:
        mine = replace(settings, **change)  # type: ignore[arg-type]
        network = build_initial_network(mine, examples).train()
        optimizer = build_optimizer(network, mine.optimizer, mine.weight_decay)

        def step() -> None:
            batch = ready if batches is None else next(batches)
            train_step(network, optimizer, batch, mine, 1e-4)

        return network, step

    def build_torch_step() -> Callable[[], object]:
        network, step = build_step({})  # type: ignore[misc]
        for layer in network.modules():
            if isinstance(layer, DepthwiseConv):
                layer.forward = super(DepthwiseConv, layer).forward  # type: ignore[method-assign]
        return step

    return {
        "loading only": lambda: collate(examples, chosen),
        "loading and augmentation": lambda: next(fresh),
        "training with augmentation": build_step({}, fresh)[1],  # type: ignore[index]
        "training in memory": build_step({})[1],  # type: ignore[index]
        "the same, torch's backward pass": build_torch_step(),
        "the same, float32": build_step({"precision": "float32"})[1],  # type: ignore[index]
        "locanet in memory": build_step({"architecture": "locanet"})[1],  # type: ignore[index]
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("images", type=int, nargs="?", default=128)
    parser.add_argument("--recipe", default="published_best")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    keep_freed_memory(2**31 - 1)  # like `dmrl train`
    settings = replace(recipe.load(args.recipe, "train", TrainConfig), device="cpu")
    spent: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as name:
        measured = build_steps(build(Path(name), args.images), settings)
        for turn in range(TURNS + 1):
            for title in sorted(measured, reverse=bool(turn % 2)):
                begun = time.process_time()
                for _ in range(STEPS):
                    measured[title]()
                seconds = (time.process_time() - begun) / STEPS
                if turn:  # the first turn is a warm-up
                    spent.setdefault(title, []).append(seconds)
    rates = {t: settings.batch_size / float(np.median(spent[t])) for t in measured}
    rows = [(title, round(rate)) for title, rate in rates.items()]
    what = f"{args.recipe}, batches of {settings.batch_size}, {args.threads} threads"
    print_table(what, ("work", "images per cpu-second"), rows)


if __name__ == "__main__":
    main()
