"""What one item costs: CPU of label for each pair and second, of dataset for each image, bytes.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/bench_items.py

Simulated flights (`dmrl fly --trajectory random --noise calibrated`) with drawn pictures at 5 Hz of
two robots' cameras; in this process, so without its start. docs/scale.md stands on it.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from dmrl.datasets import open_dataset
from dmrl.stages import dataset, fly, label
from dmrl.terminal.tables import print_table

Row = tuple[str, str, float]


def cpu_s(work: Callable[[], object]) -> float:
    """Seconds of CPU, of all threads."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def labelling(folder: Path, robots: int, duration_s: float, seed: int) -> list[Row]:
    """Costs of labelling a flight."""
    source, out = folder / f"{robots}-{seed}.mcap", folder / f"{robots}-{seed}-labels.mcap"
    how = fly.Settings(
        robots, duration_s, "random", noise="calibrated", seed=seed, camera=True, cameras_max=2
    )
    fly.run(source, how)
    spent = cpu_s(lambda: label.run(source, out, label.Settings()))
    pairs = robots * (robots - 1)
    what = f"{robots} robots, {duration_s:g} s, seed {seed}"
    return [
        ("label, cpu-s a flight", what, spent),
        ("label, cpu-ms a directed pair and second", what, 1e3 * spent / pairs / duration_s),
        ("a recording with pictures, MB", what, source.stat().st_size / 1e6),
    ]


def images(folder: Path) -> list[Row]:
    """Costs of a dataset of what was labelled."""
    given = sorted(folder.glob("*-labels.mcap"))
    rows: list[Row] = []
    for png in (False, True):
        out = folder / f"set-{png}"
        how = dataset.Settings(keep_all=True, png=png)
        spent = cpu_s(lambda out=out, how=how: dataset.run(given, out, how, workers=1))  # type: ignore[misc]
        opened = open_dataset(out)
        count = sum(len(opened.split(name)) for name in opened.splits)
        size = sum(path.stat().st_size for path in out.rglob("*.arrow"))
        what = f"{count} images of 320 x 224 px, {'PNG' if png else 'raw'}"
        rows += [("dataset, cpu-ms an image", what, 1e3 * spent / count)]
        rows += [("dataset, kB an image", what, size / count / 1e3)]
    return rows


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "first").mkdir()
        labelling(folder / "first", 2, 6.0, 9)  # what is loaded and made once
        rows = []
        for robots, duration_s, seed in ((2, 20, 0), (2, 20, 1), (2, 60, 2), (4, 20, 3)):
            rows += labelling(folder, robots, duration_s, seed)
        rows += images(folder)
    print_table("", ("cost", "of", ""), sorted(rows))


if __name__ == "__main__":
    main()
