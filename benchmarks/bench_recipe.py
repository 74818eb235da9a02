"""Ablation of a training recipe, evaluated on held-out images of the training split.

    python benchmarks/bench_recipe.py DATASET [--recipe published_best] [--epochs 12]
        [--seeds 1] [--first-seed 0] [--only "no paste" ...] [--json OUT.json]

Every row is the recipe with one setting removed or replaced, trained anew and evaluated on the same
images: one in ten of the training split. The test split is not used. Short trainings show what
helps early; regularisation may pay off only later. The last column is the CPU time after which a
row reaches the share within 20 px of the published recipe at the end of its own 15 epochs. It needs
the row of that recipe.
"""

import argparse
import json
import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dmrl import recipe
from dmrl.learn.inference.loaded_model import load_model
from dmrl.learn.training.validation import VALIDATION_METRICS
from dmrl.stages.train import Settings, run
from dmrl.terminal.tables import print_table

PLAIN: dict[str, Any] = {
    "zoom": (1.0, 1.0),
    "rotation_deg": 0.0,
    "flip_share": 0.0,
    "mosaic_share": 0.0,
    "paste": 0.0,
    "colour": 0.0,
    "noise": 0.0,
    "blur_share": 0.0,
}
PUBLISHED = "the published recipe"
PUBLISHED_EPOCHS = 15
TEACHER = "dmrl-large"
TAUGHT = f"taught by {TEACHER}"
VARIANTS: dict[str, dict[str, Any]] = {
    "the recipe": {},
    "no whole images at the end": {"plain_epochs": 0},
    "norms never frozen": {"frozen_norm_epochs": 0},
    "no augmentation": PLAIN,
    "no paste": {"paste": 0.0},
    "no mosaic": {"mosaic_share": 0.0},
    "no mosaic, no paste": {"mosaic_share": 0.0, "paste": 0.0},
    "no zoom": {"zoom": (1.0, 1.0)},
    "one cell per robot": {"target_sigma_cells": 0.0},
    "wider targets": {"target_sigma_cells": 1.0},
    "cross entropy": {"focus": 0.0},
    "squared depth error": {"depth_loss": "squared"},
    "windows cut out": {"intrinsics": None},
    "Adam": {"optimizer": "adam"},
    "last weights kept": {"ema_steps": 0},
    "no weight decay": {"weight_decay": 0.0},
    "batches of 8": {"batch_size": 8},
    "float32": {"precision": "float32"},
    "dmrl-nano": {"architecture": "dmrl-nano"},
    "locanet": {"architecture": "locanet"},
    "depth with its spread": {"spread_weight": 1.0},
    TAUGHT: {},
    PUBLISHED: {},
}
HELD_OUT = 0.1


def iter_rows(
    dataset: Path, name: str, epochs: int, seeds: range, only: list[str]
) -> Iterator[dict[str, Any]]:
    """Train every variant; yield the mean and standard deviation over seeds of each figure."""
    for title in only or VARIANTS:
        settings = build_settings(title, name, epochs)
        begun = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            runs, teacher = Path(folder), None
            if title == TAUGHT:
                # All seeds share one teacher. The CPU time of the row includes its training.
                teacher = runs / "teacher"
                run(dataset, teacher, replace(settings, architecture=TEACHER))
            for seed in seeds:
                run(dataset, runs / str(seed), replace(settings, seed=seed), teacher=teacher)
            histories = [load_model(runs / str(seed)).training["history"] for seed in seeds]
        spent = time.process_time() - begun
        said = [history[-1] for history in histories]
        row: dict[str, Any] = {
            "variant": title,
            "cpu_s": spent / len(seeds),
            "epochs": settings.epochs,
        }
        row["within_20_px_by_epoch"] = np.mean(
            [[epoch["validation_within_20_px"] for epoch in history] for history in histories],
            axis=0,
        ).tolist()
        for figure in VALIDATION_METRICS:
            values = [epoch[f"validation_{figure}"] for epoch in said]
            row[figure] = float(np.mean(values))
            row[f"{figure}_std"] = float(np.std(values, ddof=1)) if len(seeds) > 1 else math.nan
        yield row


def build_settings(title: str, name: str, epochs: int) -> Settings:
    """Return the settings of a row; its final phases are shortened like the whole training."""
    if title == PUBLISHED:
        settings = recipe.load("locanet", "train", Settings)
        return replace(settings, epochs=PUBLISHED_EPOCHS, validation_share=HELD_OUT)
    settings = recipe.load(name, "train", Settings)
    parts = {
        name: round(epochs * getattr(settings, name) / settings.epochs)
        for name in ("plain_epochs", "frozen_norm_epochs", "ema_steps")
    }
    # One process only, since the CPU time of this process is measured.
    short = {"epochs": epochs, "validation_share": HELD_OUT, "processes": 1, **parts}
    return replace(settings, **{**short, **VARIANTS[title]})


def format_time_to_reach(row: dict[str, Any], share: float) -> str:
    """Return the CPU seconds of the epochs after which a row reaches a share; "-" if never."""
    good = np.flatnonzero(np.array(row["within_20_px_by_epoch"]) >= share)
    return f"{(good[0] + 1) * row['cpu_s'] / row['epochs']:.0f}" if len(good) else "-"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--recipe", default="published_best")
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], choices=list(VARIANTS))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = []
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for row in iter_rows(args.dataset, args.recipe, args.epochs, seeds, args.only):
        found.append(row)
        if args.json:
            args.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    goals = [row["within_20_px"] for row in found if row["variant"] == PUBLISHED]
    shown = [
        (
            row["variant"],
            *(_format(row, figure) for figure in VALIDATION_METRICS),
            round(row["cpu_s"] / row["epochs"], 1),
            format_time_to_reach(row, goals[0]) if goals else "-",
        )
        for row in found
    ]
    columns = (
        *("variant", "within 20 px", "median, px", "depth MAE, m", "AP at 16 px"),
        *("cpu-s per epoch", "cpu-s to reach the published"),
    )
    print_table(f"{args.epochs} epochs, {args.seeds} seeds", columns, shown)


def _format(row: dict[str, Any], figure: str) -> str:
    """Format a figure with its standard deviation over runs, if it is known."""
    spread = row[f"{figure}_std"]
    return f"{row[figure]:.3f}" + ("" if math.isnan(spread) else f" +- {spread:.3f}")


if __name__ == "__main__":
    main()
