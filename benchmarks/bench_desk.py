"""Plant bad labels in a dataset, and count how many the label desk shows first.

python benchmarks/bench_desk.py OUT [--seed 1] [--images 1000] [--planted 50] [--first 60]
    [--epochs 0] [--views 4] [--min-confidence 0.001]

1,000 drawings of `dmrl sketch`; in 50 of them the label of one robot is moved by 15 to 60 px. The
detections of dmrl-nano order the desk, or with `--epochs 12` those of a network trained on the
dataset with the bad labels. Prints how many planted rows are among the first 60, by suspicion and
by error, how many of these the accepted detections correct, and beside how many true places no
detection lies: there the network sees nothing, and only the label speaks against itself.
"""

import argparse
import csv
import json
from pathlib import Path

import numpy as np

import dmrl
from dmrl.viewer.flag_page import _read_dataset
from dmrl.viewer.label_suspicion import NEAR_PX, score_suspicion
from dmrl.viewer.settings import Settings


def plant(pictures: Path, count: int, seed: int) -> dict[str, tuple[float, float]]:
    """Move a label of some images; return the true pixels by file name."""
    rng = np.random.default_rng(seed)
    with (pictures / "labels.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
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
        moved[row["file"]] = (u, v)
        row["u_px"], row["v_px"] = (f"{value:.3f}" for value in new)
        for name in row:
            if name in ("left_px", "top_px", "right_px", "bottom_px"):
                row[name] = ""
    with (pictures / "labels.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return moved


def main() -> None:
    """Run the experiment and print its numbers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--images", type=int, default=1000)
    parser.add_argument("--planted", type=int, default=50)
    parser.add_argument("--first", type=int, default=60)
    parser.add_argument("--epochs", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--min-confidence", type=float, default=0.001)
    given = parser.parse_args()
    out = given.out
    out.mkdir(parents=True)
    dmrl.sketch(out / "pictures", images=given.images, seed=given.seed)
    moved = plant(out / "pictures", given.planted, given.seed)
    dmrl.convert(out / "pictures", out / "flight.mcap")
    dmrl.make_dataset(out / "flight.mcap", out / "set", split="none")
    model = Path("dmrl-nano")
    if given.epochs:
        model = out / "model"
        dmrl.train(out / "set", model, recipe="dmrl_nano", init="dmrl-nano", epochs=given.epochs)
    dmrl.predict(
        model,
        out / "flight.mcap",
        out / "seen.mcap",
        views=given.views,
        min_confidence=given.min_confidence,
    )
    desk = _read_dataset([out / "set", out / "seen.mcap"], Settings())
    with (out / "pictures/labels.csv").open(newline="", encoding="utf-8") as stream:
        files = list(dict.fromkeys(row["file"] for row in csv.DictReader(stream)))
    times = sorted(row.time_ns for row in desk.rows)
    name = dict(zip(times, files, strict=True))
    scores = score_suspicion([(row.labels, row.found) for row in desk.rows], desk.size_px)
    first = [desk.rows[k] for k in np.argsort(-scores, kind="stable")[: given.first]]
    shown = [row for row in first if name[row.time_ns] in moved]
    bad = [row for row in desk.rows if name[row.time_ns] in moved]
    fixed = sum(_is_fixed(row, moved[name[row.time_ns]], desk.threshold) for row in shown)
    by_error = sorted(desk.rows, key=lambda row: -(row.error_px or -1))[: given.first]
    said = {
        "planted": len(moved),
        "among_first": len(shown),
        "first": given.first,
        "fixed_by_accepting": fixed,
        "not_seen": sum(not _is_fixed(row, moved[name[row.time_ns]], 0.0) for row in bad),
        "among_first_by_error": sum(name[row.time_ns] in moved for row in by_error),
    }
    print(json.dumps(said))


def _is_fixed(row: object, truth: tuple[float, float], threshold: float) -> bool:
    """Return whether a confident detection lies where the moved label was."""
    found = [one for one in row.found if one["confidence"] >= threshold]  # type: ignore[attr-defined]
    return any(np.hypot(one["u_px"] - truth[0], one["v_px"] - truth[1]) < NEAR_PX for one in found)


if __name__ == "__main__":
    main()
