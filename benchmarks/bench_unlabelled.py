"""Compare adapting a network to new rooms with unlabelled flights, and with labels without UWB.

    python benchmarks/bench_unlabelled.py FOLDER [--places 651 652 653 654] [--seeds 3]

In each place two robots fly for 40 s in view of each other, with sketched images. All networks
learn from 300 labelled sketches of other places. Some also learn from the flights. They use the
consistency loss on images of one camera or on those of both robots, or labels of
``label --detections`` without ranges. All are evaluated on other flights in the same places. FOLDER
keeps all files; a later run reuses them.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import dmrl
from dmrl import recipe as recipes
from dmrl.labelling.unlabelled_training import train_with_flights
from dmrl.learn.training.config import TrainConfig
from dmrl.terminal.tables import print_table

ROBOTS = "cf1", "cf2"
LOGS = "attitude", "velocity", "height", "detections", "camera/image", "camera/calibration"
FIGURES = "ap_16_px", "recall", "depth_mae_m", "median_px"


def fly(folder: Path, place: int, seed: int) -> Path:
    """Fly in a place and run dmrl-nano on the images, unless the recording exists."""
    raw, seen = folder / f"flight-{place}-{seed}.mcap", folder / f"seen-{place}-{seed}.mcap"
    if not seen.exists():
        dmrl.fly(
            raw, recipe="fly_in_view", place=place, seed=seed, camera=True,
            camera_renderer="sketch", noise="calibrated", duration_s=40.0,
        )  # fmt: skip
        dmrl.predict("dmrl-nano", raw, seen)
    return seen


def keep(seen: Path, robots: Sequence[str]) -> Path:
    """Copy the topics of some robots without ranges, unless the copy exists."""
    out = seen.with_name(f"{'-'.join(robots)}-of-{seen.name}")
    if not out.exists():
        dmrl.trim(seen, out, topic=[f"/{robot}/{log}" for robot in robots for log in LOGS])
    return out


def draw(folder: Path) -> Path:
    """Sketch labelled images of other places, unless the recording exists."""
    out = folder / "sketches.mcap"
    if not out.exists():
        pictures = dmrl.sketch(folder / "sketches", images=300, empty_share=0.4, seed=5)
        dmrl.convert(pictures, out)
    return out


def label(flights: Sequence[Path]) -> list[Path]:
    """Label flights by detections and odometry, unless the labels exist."""
    outs = [flight.with_name(f"labelled-{flight.name}") for flight in flights]
    for flight, out in zip(flights, outs, strict=True):
        if not out.exists():
            dmrl.label(flight, out, detections=True)
    return outs


def make_dataset(out: Path, recordings: Sequence[Path]) -> Path:
    """Make a dataset of all images, unless it exists."""
    if not out.exists():
        dmrl.make_dataset(list(recordings), out, split="none")
    return out


def train(folder: Path, flights: Sequence[Path], weight: float, seed: int) -> dict[str, Path]:
    """Train the networks, unless they exist; return their folders by title."""
    apart = [keep(flight, [robot]) for flight in flights for robot in ROBOTS]
    together = [keep(flight, ROBOTS) for flight in flights]
    sketches = draw(folder)
    plain = make_dataset(folder / "plain", [sketches])
    labelled = make_dataset(folder / "labelled", [*label(together), sketches])
    settings = replace(
        recipes.load("own_camera", "train", TrainConfig),
        epochs=8,
        epoch_images=160,
        warmup_epochs=1,
        plain_epochs=3,
        frozen_norm_epochs=3,
        learning_rate=5e-4,
        consistency_weight=weight,
        seed=seed,
    )
    mixed = replace(settings, shares={"labelled*": 0.6, "sketches*": 0.4}, label_noise="weight")
    arms: dict[str, tuple[Path, TrainConfig, list[Path]]] = {
        "sketches of other places": (plain, settings, []),
        "and flights, of one camera": (plain, settings, apart),
        "and flights, of two robots": (plain, settings, together),
        "and labels without UWB": (labelled, mixed, []),
    }
    models = {}
    for title, (data, one, unlabelled) in arms.items():
        models[title] = folder / f"{title.replace(' ', '-')}-{weight:g}-{seed}"
        if not models[title].exists():
            init = Path("dmrl-nano")
            train_with_flights(data, models[title], one, init=init, unlabelled=unlabelled)
    return models


def judge(model: Path, flights: Sequence[Path]) -> list[float]:
    """Return the mean figures of a network over some flights."""
    rows = []
    for flight in flights:
        seen = model / f"on-{flight.name}"
        if not seen.exists():
            dmrl.predict(model, flight, seen)
        overall = dmrl.evaluate(seen, draws=1)["overall"]
        rows.append([float(overall[name]["value"]) for name in FIGURES])
    return [float(value) for value in np.mean(rows, axis=0)]


def main() -> None:
    """Fly, train, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--places", type=int, nargs="+", default=[651, 652, 653, 654])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--weight", type=float, default=10.0, help="consistency_weight")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    flights = [fly(given.folder, place, 1) for place in given.places]
    judged = [fly(given.folder, place, 11) for place in given.places]
    found: dict[str, list[list[float]]] = {"dmrl-nano": [judge_shipped(given.folder, judged)]}
    for seed in range(given.seeds):
        for title, model in train(given.folder, flights, given.weight, seed).items():
            found.setdefault(title, []).append(judge(model, judged))
    rows = [
        [title, *(f"{m:.3f} +- {s:.3f}" for m, s in zip(*spread, strict=True))]
        for title, figures in found.items()
        for spread in ((np.mean(figures, axis=0), np.std(figures, axis=0)),)
    ]
    headers = ["training", *FIGURES]
    print_table(f"flights in the same places, mean and std of {given.seeds} seeds", headers, rows)


def judge_shipped(folder: Path, flights: Sequence[Path]) -> list[float]:
    """Return the mean figures of the shipped network, whose detections `fly` has recorded."""
    rows = [dmrl.evaluate(flight, draws=1)["overall"] for flight in flights]
    return [float(np.mean([row[name]["value"] for row in rows])) for name in FIGURES]


if __name__ == "__main__":
    main()
