"""What a smaller network costs in accuracy: grey images, half the width, half the size.

Run as ``python benchmarks/bench_sizes.py DATASET --epochs 30 [--plot STEM]``. Each form of the
default network is trained on the train split with the default recipe and one seed, quantised,
and judged in int8 on the test split; errors are in pixels of the full image. RAM is that of the
row-by-row C. The rate is an estimate for a GAP8: hand-written kernels on 8 cores at 175 MHz, 4.1
multiply-accumulates a cycle.
"""

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl import plots
from dmrl.datasets import Dataset, Split, open_dataset
from dmrl.datasets.for_training import examples_of
from dmrl.deploy.accuracy import figures_of, points_of
from dmrl.deploy.backends import integer
from dmrl.deploy.c import write_c
from dmrl.deploy.equalise import equalise
from dmrl.deploy.graph import graph_of, grey_of
from dmrl.deploy.integer import IntegerNetwork
from dmrl.deploy.measure import Memory, memory_of, rates
from dmrl.deploy.quantise import About, quantise
from dmrl.deploy.ranges import calibrate
from dmrl.deploy.rounding import moments_of
from dmrl.evaluation.detections import labels_of_split
from dmrl.images.codec import crop_and_scale
from dmrl.learn.batches import FIELDS, Examples
from dmrl.learn.fit import Training, new_network
from dmrl.learn.matching import Points
from dmrl.learn.network import ARCHITECTURES, DmrlNano, Network
from dmrl.learn.settings import FitSettings
from dmrl.learn.trace import operations

Images = NDArray[np.uint8]
THRESHOLD = 0.33
PIXEL_FIELDS = [k for k, name in enumerate(FIELDS) if name.endswith("_px")]


class HalfNano(DmrlNano):
    """The default network, half as wide."""

    widths = (8, 16, 24)


@dataclass(frozen=True)
class Form:
    """A form of the network."""

    name: str
    architecture: str = "dmrl-nano"
    grey: bool = False
    shrink: int = 1


FORMS = (
    Form("320x224 RGB"),
    Form("320x224 grey", grey=True),
    Form("320x224 RGB, half width", "half-nano"),
    Form("320x224 grey, half width", "half-nano", grey=True),
    Form("160x112 RGB", shrink=2),
    Form("160x112 grey", grey=True, shrink=2),
    Form("160x112 grey, half width", "half-nano", grey=True, shrink=2),
)


@dataclass(frozen=True)
class Judged:
    """What a form came to."""

    name: str
    mmac: float
    ram_bytes: int
    rate_hz: float
    within_20_px: float
    median_px: float
    depth_mae_m: float
    ap_16_px: float


def seen_as(form: Form, image: Images) -> Images:
    """An image as a form of the network sees it: three equal colours where it is grey."""
    if form.shrink > 1:
        height_px, width_px, _ = image.shape
        box = (0.0, 0.0, float(width_px), float(height_px))
        image = crop_and_scale(image, box, width_px // form.shrink, height_px // form.shrink)
    return np.repeat(grey_of(image[None])[0], 3, axis=2) if form.grey else image


def images_of(split: Split, form: Form, most: int) -> Images:
    """The first images of a split, as a form sees them."""
    every = (image for chunk in split.pixels for image in chunk)
    return np.stack([seen_as(form, image) for image, _ in zip(every, range(most), strict=False)])


def trained(data: Dataset, form: Form, settings: FitSettings, most: int) -> tuple[Network, Images]:
    """The network, trained, and the images that it learnt from."""
    images = images_of(data.split("train"), form, most)
    robots = examples_of(data.split("train")).robots[: len(images)].copy()
    robots[..., PIXEL_FIELDS] /= form.shrink
    examples = Examples([images], robots)
    settings = replace(settings, architecture=form.architecture)
    with tempfile.TemporaryDirectory(prefix="dmrl-sizes-") as folder:
        network = new_network(settings, examples)
        training = Training(network, examples, settings, Path(folder))
        for _ in training.steps():
            pass
    return training.network.eval(), images


def judged(data: Dataset, form: Form, settings: FitSettings, most: int) -> Judged:
    """Accuracy in int8, and what it costs."""
    network, images = trained(data, form, settings, most)
    graph = graph_of(operations(network))
    graph = graph.grey() if form.grey else graph
    some = images[:: max(1, len(images) // 100)]
    graph, ranges = equalise(graph, calibrate(graph, (image[None] for image in some)))
    about = About(form.name, form.architecture, network.stride_px, network.channels, THRESHOLD)
    small = quantise(graph, ranges, about, moments_of(graph, some[:50]))
    test = data.split("test")
    seen = images_of(test, form, len(test))
    points = points_of(integer(small).outputs(seen), small.stride_px)
    labels = labels_of_split(test, range(len(test)))
    found = figures_of(len(test), labels, _scaled(points, form.shrink), THRESHOLD)
    names = ("within_20_px", "median_px", "depth_mae_m", "ap_16_px")
    figures = {name: float(found[name] or 0) for name in names}
    kept = memory(small)
    rate_hz = rates(small, None, kept)[0][0]
    return Judged(form.name, small.macs / 1e6, kept.state_bytes, rate_hz, **figures)


def _scaled(points: Points, factor: int) -> Points:
    return replace(points, u_px=points.u_px * factor, v_px=points.v_px * factor)


def memory(network: IntegerNetwork) -> Memory:
    """What the C keeps."""
    with tempfile.TemporaryDirectory(prefix="dmrl-sizes-") as folder:
        write_c(network, Path(folder), [])
        return memory_of(network, Path(folder))


def print_line(each: Judged) -> None:
    """Print a form."""
    costs = f"{each.mmac:>7.1f}{each.ram_bytes:>9}{each.rate_hz:>8.1f}"
    figures = f"{each.within_20_px:>9.1%}{each.median_px:>8.2f}{each.depth_mae_m:>8.3f}"
    print(f"{each.name:<26}{costs}{figures}{each.ap_16_px:>7.3f}", flush=True)


def draw(found: Sequence[Judged], stem: Path) -> None:
    """Accuracy against multiply-accumulates and RAM."""
    costs = {
        "million multiply-accumulates": [each.mmac for each in found],
        "RAM of the C, kB": [each.ram_bytes / 1000 for each in found],
        "estimated images/s on a GAP8": [each.rate_hz for each in found],
    }
    plots.trade_offs(
        costs, [100 * each.within_20_px for each in found], [each.name for each in found],
        "within 20 px, %", stem,
    )  # fmt: skip


def main() -> None:
    """Train, quantise and judge every form."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--images", type=int, default=10**9, help="learn from the first so many")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of forms")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    asked = parser.parse_args()
    ARCHITECTURES["half-nano"] = HalfNano
    data = open_dataset(asked.dataset)
    settings = FitSettings(epochs=asked.epochs, device="cpu")
    print(f"{'':<26}{'MMAC':>7}{'RAM':>9}{'1/s':>8}{'20 px':>9}{'median':>8}{'depth':>8}{'AP':>7}")
    found = []
    for number, form in enumerate(FORMS):
        if asked.only is None or number in asked.only:
            found.append(judged(data, form, settings, asked.images))
            print_line(found[-1])
    if asked.json:
        asked.json.write_text(json.dumps([asdict(each) for each in found], indent=1) + "\n")
    if asked.plot:
        draw(found, asked.plot)


if __name__ == "__main__":
    main()
