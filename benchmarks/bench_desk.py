"""Plant bad labels in a dataset, and measure how many the label desk finds and what that gains.

python benchmarks/bench_desk.py OUT [--seed 1] [--images 1000] [--planted 50] [--first 60]
    [--views 1] [--min-confidence 0.01] [--epochs 0] [--held 500]

`dmrl sketch` draws 1,000 images. In 50 of them the label of one robot is moved by 15 to 60 px. The
detections of dmrl-nano determine the order of images on the desk. Prints how many planted images
are among the first 60, ordered by suspicion and by error. Of these, prints how many are corrected
by accepting the detection, and how many true positions have no detection nearby: there the
network misses the robot, and only the label itself can look suspicious.

Then the planted labels among the first 60 images are corrected with the truth, in a recording like
that saved by the page, which `dmrl dataset` reads. Prints the average precision of dmrl-nano on the
same images, against the labels of the dataset before and after. With --epochs, also trains a
network on both datasets by the recipe own_camera, and prints its average precision and that of
dmrl-nano on 500 other drawings with correct labels. An epoch of both takes a minute of one core.
"""

import argparse
import csv
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import dmrl
from dmrl import topics
from dmrl.messages import STATUS_OK, message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.recording.provenance import Input
from dmrl.viewer import Settings, flag
from dmrl.viewer.label_suspicion import NEAR_PX

Row = dict[str, Any]
UNKNOWN = {"sigma_u_px": 0.0, "sigma_v_px": 0.0, "box_px": [], "status": STATUS_OK}
"""Fields of a label that was moved on the page."""
HELD_SEED = 1000
"""Added to the seed for the drawings with correct labels."""


class Moved(NamedTuple):
    """A label that was moved: its true pixel, and its pixel in the dataset."""

    truth: tuple[float, float]
    planted: tuple[float, float]


def plant(pictures: Path, count: int, seed: int) -> dict[str, Moved]:
    """Move one label in each of some images; return the moved labels by file name."""
    rng = np.random.default_rng(seed)
    rows = _read_labels(pictures)
    inside = [
        k
        for k, row in enumerate(rows)
        if row["u_px"] and 15 < float(row["u_px"]) < 305 and 15 < float(row["v_px"]) < 209
    ]
    one_each = {rows[k]["file"]: k for k in rng.permutation(inside)}
    moved = {}
    for k in rng.choice(sorted(one_each.values()), count, replace=False):
        row = rows[k]
        u, v = float(row["u_px"]), float(row["v_px"])
        while True:
            angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(15, 60)
            new = u + far * np.cos(angle), v + far * np.sin(angle)
            if 0 < new[0] < 320 and 0 < new[1] < 224:
                break
        moved[row["file"]] = Moved((u, v), new)
        row["u_px"], row["v_px"] = (f"{value:.3f}" for value in new)
        row |= dict.fromkeys(("left_px", "top_px", "right_px", "bottom_px"), "")
    _write_labels(pictures / "labels.csv", rows)
    return moved


def _read_labels(pictures: Path) -> list[Row]:
    """Return the rows of the label table in a folder of pictures."""
    with (pictures / "labels.csv").open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def _write_labels(out: Path, rows: list[Row]) -> None:
    """Write rows as a label table."""
    with out.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """Run the experiment and print its numbers."""
    given = _parse_arguments()
    out: Path = given.out
    out.mkdir(parents=True)
    dmrl.sketch(out / "pictures", images=given.images, seed=given.seed)
    moved = plant(out / "pictures", given.planted, given.seed)
    dmrl.convert(out / "pictures", out / "flight.mcap")
    dmrl.make_dataset(out / "flight.mcap", out / "before", split="none")
    settings = {"views": given.views, "min_confidence": given.min_confidence}
    dmrl.predict("dmrl-nano", out / "flight.mcap", out / "seen.mcap", **settings)
    flag([out / "before", out / "seen.mcap"], out / "desk.html", Settings())
    desk = _read_page(out / "desk.html", out / "pictures")
    print(json.dumps(count_found(desk, moved, given.first)), flush=True)
    corrections = out / "corrections-flight.mcap"
    correct(desk, moved, given.first, corrections)
    dmrl.make_dataset(out / "flight.mcap", out / "after", split="none", corrections=[corrections])
    precision = {name: measure_labels(out, name) for name in ("before", "after")}
    print(json.dumps({"ap_against_labels": precision}), flush=True)
    if given.epochs:
        dmrl.sketch(out / "held", images=given.held, seed=HELD_SEED + given.seed)
        dmrl.convert(out / "held", out / "held.mcap")
        precision = {"dmrl-nano": measure_network(Path("dmrl-nano"), out)}
        for name in ("before", "after"):
            model = out / f"trained-{name}"
            dmrl.train(
                out / name, model, recipe="own_camera", init="dmrl-nano", epochs=given.epochs
            )
            precision[name] = measure_network(model, out)
        print(json.dumps({"ap_of_networks": precision}))


def _parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    numbers = {"images": 1000, "planted": 50, "first": 60, "seed": 1, "views": 1}
    numbers |= {"epochs": 0, "held": 500}
    for name, value in numbers.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--min-confidence", type=float, default=0.01)
    return parser.parse_args()


def _read_page(page: Path, pictures: Path) -> dict[str, Any]:
    """Return the data of the page; the file name of its image is added to each row."""
    text = page.read_text(encoding="utf-8")
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text)
    desk: dict[str, Any] = json.loads(data)
    files = dict.fromkeys(row["file"] for row in _read_labels(pictures))
    desk["rows"].sort(key=lambda row: int(row["time_ns"]))
    for row, file in zip(desk["rows"], files, strict=True):
        row["file"] = file
    return desk


def count_found(desk: dict[str, Any], moved: dict[str, Moved], first: int) -> dict[str, int]:
    """Count the planted images among the first, and those that accepting a detection corrects."""
    bad = [row for row in desk["rows"] if row["file"] in moved]
    shown = [row for row in _list_first(desk, first) if row["file"] in moved]
    by_error = _list_first(desk, first, "error_px")
    return {
        "planted": len(moved),
        "among_first": len(shown),
        "first": first,
        "fixed_by_accepting": sum(_is_seen(row, moved, desk["threshold"]) for row in shown),
        "not_seen": sum(not _is_seen(row, moved, 0.0) for row in bad),
        "among_first_by_error": sum(row["file"] in moved for row in by_error),
    }


def _list_first(desk: dict[str, Any], count: int, order: str = "suspicion") -> list[Row]:
    """Return the rows that the page shows first."""
    return sorted(desk["rows"], key=lambda row: -(row[order] or -1))[:count]


def _is_seen(row: Row, moved: dict[str, Moved], least: float) -> bool:
    """Return whether a detection of that confidence lies where the moved label was."""
    u, v = moved[row["file"]].truth
    found = [one for one in row["found"] if one["confidence"] >= least]
    return any(np.hypot(one["u_px"] - u, one["v_px"] - v) < NEAR_PX for one in found)


def correct(desk: dict[str, Any], moved: dict[str, Moved], first: int, out: Path) -> None:
    """Write a recording like the page's that moves the planted labels of the first rows back."""
    (source,) = desk["provenance"]
    rows = [row for row in _list_first(desk, first) if row["file"] in moved]
    made = Provenance("desk", {"page": "before"}, inputs=(Input(source, ""),))
    with RecordingWriter(out, made) as sink:
        for row in sorted(rows, key=lambda row: int(row["time_ns"])):
            (u, v), planted = moved[row["file"]]
            peers = [label | {"source": "hand"} for label in row["labels"]]
            away = [np.hypot(one["u_px"] - planted[0], one["v_px"] - planted[1]) for one in peers]
            peers[int(np.argmin(away))] |= UNKNOWN | {"u_px": u, "v_px": v}
            message = message_class("PeerLabels")(peers=peers, sources=["hand"])
            sink.write(int(row["time_ns"]), topics.LABELS(row["robot"]), message)


def measure_labels(out: Path, name: str) -> float:
    """Return the average precision at 16 px of dmrl-nano against the labels of a dataset."""
    files = list(dict.fromkeys(row["file"] for row in _read_labels(out / "pictures")))
    table = dmrl.dataset(out / name)["train"].to_pandas()
    times = sorted(table["log_time"].unique())
    file = dict(zip(times, files, strict=True))
    columns = ("peer", "u_px", "v_px", "depth_m")
    rows = [
        {"file": file[row["log_time"]]} | {column: row[column] for column in columns}
        for row in table.fillna("").to_dict("records")
    ]
    _write_labels(out / f"{name}.csv", rows)
    dmrl.convert(out / "pictures", out / f"{name}.mcap", labels=out / f"{name}.csv")
    dmrl.predict("dmrl-nano", out / f"{name}.mcap", out / f"{name}-seen.mcap")
    return _read_precision(out / f"{name}-seen.mcap", "hand")


def measure_network(model: Path, out: Path) -> float:
    """Return the average precision at 16 px of a network on the drawings with correct labels."""
    seen = out / f"held-{model.name}.mcap"
    dmrl.predict(model, out / "held.mcap", seen)
    return _read_precision(seen)


def _read_precision(seen: Path, against: str = "truth") -> float:
    """Return the average precision within 16 px of a recording's detections."""
    found = dmrl.evaluate(seen, against=against)
    return round(float(found["overall"]["ap_16_px"]["value"]), 4)


if __name__ == "__main__":
    main()
