"""The release gate of a shipped network: figures, and limits that they must keep.

    python benchmarks/release_gate.py MODEL DATA [--part choose|judge] [--held HELD.mcap ...]
        [--flights N] [--floors NAME] [--json] [--curve OUT.png]
        [--calibrate OUT [--threshold-anew] [--renders-only]]

DATA is a folder with the published renders, real images and cut-outs (`locanet-synthetic`,
`locanet-multi`, `aideck-frames`, `aideck-empty`, `himax-frames`, `cutouts`); missing ones are
skipped.

* `--part choose` uses the data on which settings may be tuned: the published training images, on
  which no shipped network was trained, and every second image without a drone.
* `--part judge` uses the published test images and the remaining images, for a release.
* `--held` adds renders, with recall by distance. It may be repeated.
* `--flights N` flies `fly_follow` N times with the network. Seeds start at 500, or at 600 for the
  part `judge`.
* `--calibrate OUT` writes the network with its confidence calibrated on the part `choose` and the
  renders; `--renders-only` leaves real images out of the calibration.

A composite is a cut-out of a Crazyflie, 18 to 110 px wide, on an image without a drone; each image
is used twice. "Right" means that the most confident detection is within 16 px, and "believed" that
it is also above the threshold. The limits are in release_gate.toml beside this file. The exit
status is 1 if a figure is outside its limits.
"""

import argparse
import json
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from gate_sets import (
    SIZE_PX,
    Set,
    join,
    load_empty,
    load_frames,
    load_published,
    load_renders,
    make_composites,
)

from dmrl import recipe as recipes
from dmrl.estimation.tracking.flight_metrics import compute_flight_figures
from dmrl.evaluation.flights import judge
from dmrl.images.codec import Rgb
from dmrl.learn.inference.confidence_calibration import apply_calibration, fit_calibration
from dmrl.learn.inference.decode_grids import decode as decode_grids
from dmrl.learn.inference.detection_metrics import (
    ScoredDetections,
    compute_curves,
    compute_metrics,
    score_detections,
)
from dmrl.learn.inference.loaded_model import Model, load_model, save_model
from dmrl.learn.inference.matching import Points
from dmrl.learn.inference.threshold import count_false_alarms, find_unlabelled_images
from dmrl.learn.pretrained import resolve_model_path
from dmrl.simulation.flight_recording import FlySettings, record_flight
from dmrl.terminal.tables import print_table

FLOORS = Path(__file__).with_suffix(".toml")
FLIGHT_SEEDS = {"choose": 500, "judge": 600}


def calibrate(model: Model, scored: dict[str, ScoredDetections], out: Path, *, anew: bool) -> None:
    """Write the network with calibrated confidence.

    The renders, and the composites together with empty real images, have equal weight. Threshold
    and detector rates are converted to the new confidence, so that the same detections pass. With
    ``anew`` the threshold becomes the lowest at which empty renders have at most 0.02 detections
    per image.
    """
    groups = [scored[name] for name in ("held", "composites_and_empty") if name in scored]
    images = np.cumsum([0, *(one.images for one in groups)])[:-1]
    labels, found = (
        Points.concatenate([getattr(one, part) for one in groups], images)
        for part in ("labels", "detections")
    )
    every = score_detections(sum(one.images for one in groups), labels, found)
    source = np.repeat(np.arange(len(groups)), [one.images for one in groups])
    scaling = fit_calibration(every, source)
    if scaling is None or not apply_calibration(model.network, scaling):
        raise SystemExit("too few detections to calibrate")
    rates = None if model.rates is None else dict(model.rates)
    if rates:
        least = np.log(rates["min_confidence"] / (1 - rates["min_confidence"]))
        rates["min_confidence"] = 1 / (1 + np.exp(-scaling.slope * least - scaling.offset))
        rates["offset"] -= rates["slope"] * scaling.offset / scaling.slope
        rates["slope"] /= scaling.slope
        rates = {k: np.round(v, 4).tolist() for k, v in rates.items()}
    before = model.threshold
    if anew:
        before = compute_recall_by_distance("", scored["held"])[".threshold_at_0.02"]
    logit = scaling.slope * np.log(before / (1 - before)) + scaling.offset
    known = {**model.training, "calibrated_again": scaling._asdict()}
    threshold = round(float(1 / (1 + np.exp(-logit))), 4)
    out.mkdir(parents=True)
    save_model(replace(model, threshold=threshold, rates=rates, training=known), out)
    print(f"{out}: slope {scaling.slope:.3f}, offset {scaling.offset:.3f}, threshold {threshold}")


def score(model: Model, data: Set) -> ScoredDetections:
    """Run a network on a set and match its detections with the labels."""
    images, labels = data
    parts = []
    for start in range(0, len(images), 16):
        grids = model.grids(np.stack(images[start : start + 16]))
        found = decode_grids(*grids, stride_px=model.network.stride_px)
        image, at = np.nonzero(np.arange(found.u_px.shape[1]) < found.count[:, None])
        columns = (found.u_px, found.v_px, found.depth_m, found.confidence)
        parts.append(Points(image, *(column[image, at] for column in columns)))
    inside = []
    for row in labels:
        seen = (row[:, :2] >= 0).all(axis=1) & (row[:, :2] < SIZE_PX).all(axis=1)
        inside.append(row[seen])
    flat = np.concatenate([np.zeros((0, 3)), *inside])
    image = np.repeat(np.arange(len(inside)), [len(row) for row in inside])
    points = Points(image, *flat.T, np.ones(len(flat)))
    first = np.arange(0, len(images), 16)
    return score_detections(len(images), points, Points.concatenate(parts, first))


def compute_errors(name: str, scored: ScoredDetections, threshold: float) -> dict[str, float]:
    """Return errors, average precision and explained variance of a set with labels."""
    one = np.ones((1, scored.images))
    got = {k: float(v[0]) for k, v in compute_metrics(scored, (0, np.inf), threshold, one).items()}
    kept = ("within_20_px", "median_px", "ap_16_px", "depth_mae_m", "r2_u", "r2_v", "r2_depth")
    return {f"{name}.{key}": got[key] for key in kept}


def score_best(name: str, scored: ScoredDetections, threshold: float) -> dict[str, float]:
    """Return the shares of images with one label whose best detection is right, and believed."""
    best = scored.detections.ranks_in_image() == 0
    right = scored.right_16_px[best] >= 0
    believed = right & (scored.detections.confidence[best] >= threshold)
    sure = scored.detections.confidence >= threshold
    false = float((sure & (scored.right_16_px < 0)).sum())
    return {
        f"{name}.right_first": float(right.mean()),
        f"{name}.believed": float(believed.mean()),
        f"{name}.false_an_image": false / scored.images,
    }


def count_alarms(name: str, scored: ScoredDetections, threshold: float) -> dict[str, float]:
    """Return the share of empty images with a detection, and the number of detections from 0.9."""
    image, confidence = scored.detections.image, scored.detections.confidence
    share = len(np.unique(image[confidence >= threshold])) / scored.images
    return {f"{name}.alarms": share, f"{name}.at_0.9": float((confidence >= 0.9).sum())}


def compute_recall_by_distance(name: str, scored: ScoredDetections) -> dict[str, float]:
    """Return recall by distance at the threshold with 0.02 false detections per empty image."""
    image, confidence = scored.detections.image, scored.detections.confidence
    bare = find_unlabelled_images(scored)
    ghosts = np.sort(confidence[bare[image]])[::-1]
    allowed = int(0.02 * bare.sum())
    threshold = float(ghosts[allowed]) if allowed < len(ghosts) else 0.0
    found = np.zeros(len(scored.labels), bool)
    sure = (confidence > threshold) & (scored.right_16_px >= 0)
    found[scored.right_16_px[sure]] = True
    depth = scored.labels.depth_m
    out = {f"{name}.threshold_at_0.02": threshold}
    for low, high in ((0, 0.5), (0.5, 1), (1, 1.5), (1.5, 2.3)):
        mine = (depth >= low) & (depth < high)
        if mine.any():
            out[f"{name}.recall_{low:g}_{high:g}_m"] = float(found[mine].mean())
    return out


def measure_reliability(name: str, scored: ScoredDetections) -> dict[str, float]:
    """Return confidence and share right of detections from 0.8, and the mean calibration error."""
    sure = scored.detections.confidence >= 0.8
    right = (scored.right_16_px >= 0)[sure]
    said = scored.detections.confidence[sure]
    if not len(said):
        return {}
    curves = compute_curves(scored)
    gap = np.abs(curves.bin_confidence - curves.bin_right)
    # The lowest bin, confidence below 0.1, is left out: such detections are never used.
    weight = np.where(np.arange(10) >= 1, curves.bin_count, 0)
    return {
        f"{name}.said_at_0.8": float(said.mean()),
        f"{name}.right_at_0.8": float(right.mean()),
        f"{name}.calibration_gap": float(np.nansum(gap * weight) / max(weight.sum(), 1)),
    }


def score_far(name: str, scored: ScoredDetections) -> dict[str, float]:
    """Return the share of labels beyond 1.8 m found within 20 px, and the number of such labels."""
    mine = scored.labels.depth_m >= 1.8
    error = scored.label_error.norm_px[mine]
    return {
        f"{name}.within_20_px_from_1.8_m": float((error <= 20).mean()),
        f"{name}.far": mine.sum(),
    }


def fly(eye: Path, part: str, count: int) -> dict[str, float]:
    """Fly some flights; return mean and minimum of the seconds that the leader is held in view."""
    recipe = recipes.load("fly_follow", "fly", FlySettings)
    held_s, false = [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(FLIGHT_SEEDS[part], FLIGHT_SEEDS[part] + count):
            out = Path(folder) / f"{seed}.mcap"
            record_flight(out, replace(recipe, eye=eye, seed=seed))
            found = compute_flight_figures(judge(out)[0])
            held_s.append(found["held_s"] or 0.0)
            false.append(found["false_per_image"] or 0.0)
    return {
        "flights.held_s": float(np.mean(held_s)),
        "flights.least_held_s": float(np.min(held_s)),
        "flights.false_an_image": float(np.mean(false)),
    }


def compute_figures(
    model: Model, data: Path, part: str, held: Sequence[Path]
) -> tuple[dict[str, float], dict[str, ScoredDetections]]:
    """Return all figures of a network, and the scored detections by set."""
    split = "train" if part == "choose" else "test"
    threshold, figures = model.threshold, {"threshold": model.threshold}
    scored: dict[str, ScoredDetections] = {}
    bare: list[Rgb] = []
    if (folder := data / "locanet-synthetic").is_dir():
        scored["single"] = score(model, load_published(folder, split=split))
        figures |= compute_errors("single", scored["single"], threshold)
        figures |= score_far("single", scored["single"])
    if part == "judge" and (folder := data / "locanet-multi").is_dir():
        scored["multi"] = score(model, load_published(folder, split=None))
        figures |= compute_errors("multi", scored["multi"], threshold)
    if (folder := data / "aideck-frames").is_dir():
        figures |= score_best("frames", score(model, load_frames(folder)), threshold)
    for name in ("himax-frames", "aideck-empty"):
        if (folder := data / name).is_dir():
            images = load_empty(folder, part)
            bare += images[0]
            scored[name] = score(model, images)
            figures |= count_alarms(name, scored[name], threshold)
    if bare and (folder := data / "cutouts").is_dir():
        drawn = make_composites(folder, bare, 0 if part == "choose" else 1)
        scored["composites"] = score(model, drawn)
        figures |= score_best("composites", scored["composites"], threshold)
        both = (drawn[0] + bare, drawn[1] + [np.zeros((0, 3))] * len(bare))
        scored["composites_and_empty"] = score(model, both)
        both_scored = scored["composites_and_empty"]
        figures |= measure_reliability("composites_and_empty", both_scored)
    if held:
        scored["held"] = score(model, join([load_renders(recording) for recording in held]))
        figures |= compute_errors("held", scored["held"], threshold)
        figures |= compute_recall_by_distance("held", scored["held"])
        figures |= measure_reliability("held", scored["held"])
        alarmed = count_false_alarms(scored["held"], threshold)
        figures |= {"held.false_an_empty_image": alarmed.false_alarms}
    return figures, scored


def draw_curves(scored: dict[str, ScoredDetections], out: Path) -> None:
    """Draw the reliability curve of every set with labels."""
    import matplotlib.pyplot as plt  # noqa: PLC0415 - only for the picture

    figure, axes = plt.subplots(figsize=(4.5, 4), layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.7")
    for name, one in scored.items():
        if len(one.labels):
            curves = compute_curves(one)
            seen = curves.bin_count >= 5
            axes.plot(curves.bin_confidence[seen], curves.bin_right[seen], "o-", label=name)
    axes.set(xlabel="confidence", ylabel="share right within 16 px")
    axes.legend()
    figure.savefig(out, dpi=110)


def main() -> int:
    """Print every figure with its limits; return 1 if one is outside them, else 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--part", choices=("choose", "judge"), default="choose")
    parser.add_argument("--held", type=Path, action="append", default=[])
    parser.add_argument("--flights", type=int, default=0, metavar="N")
    parser.add_argument("--floors", help="table of release_gate.toml; default: name of the model")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--curve", type=Path)
    parser.add_argument("--calibrate", type=Path, metavar="OUT")
    parser.add_argument("--threshold-anew", action="store_true")
    parser.add_argument("--renders-only", action="store_true")
    given = parser.parse_args()
    path = resolve_model_path(given.model)
    model = load_model(path)
    figures, scored = compute_figures(model, given.data, given.part, given.held)
    if given.flights:
        figures |= fly(path, given.part, given.flights)
    if given.renders_only:  # for a network that only has to work on the published renders
        scored.pop("composites_and_empty", None)
    if given.calibrate:
        calibrate(model, scored, given.calibrate, anew=given.threshold_anew)
    name = given.floors or given.model.name
    floors = tomllib.loads(FLOORS.read_text()).get(name, {}) if FLOORS.is_file() else {}
    if given.curve:
        draw_curves(scored, given.curve)
    failed, rows = [], []
    for key, value in figures.items():
        low, high = floors.get(key, [-np.inf, np.inf])
        bad = given.part == "judge" and not low <= value <= high
        failed += [key] * bad
        limits = f"{low:g} to {high:g}" if key in floors else ""
        rows.append((key, f"{value:.3f}", limits, "outside its limits" if bad else ""))
    if given.json:
        json.dump({k: float(v) for k, v in figures.items()}, sys.stdout, indent=1)
    else:
        print_table(f"{name}, {given.part}", ("figure", "value", "limits", ""), rows)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
