"""Measure costs per item: CPU time of label per pair and second, of dataset per image, and bytes.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/bench_items.py

The flights are simulated (`dmrl fly --trajectory random --noise calibrated`), with images drawn at
5 Hz for the cameras of two robots. The stages run in this process, so their start-up is not
included. docs/scale.md uses these figures.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from dmrl.datasets import open_dataset
from dmrl.stages import dataset, fly, label
from dmrl.terminal.tables import print_table

Row = tuple[str, str, float]


def measure_cpu_s(work: Callable[[], object]) -> float:
    """Return the CPU seconds of some work, over all threads."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def measure_labelling(folder: Path, robots: int, duration_s: float, seed: int) -> list[Row]:
    """Simulate and label a flight; return its costs."""
    source, out = folder / f"{robots}-{seed}.mcap", folder / f"{robots}-{seed}-labels.mcap"
    how = fly.Settings(
        robots, duration_s, "random", noise="calibrated", seed=seed, camera=True, cameras_max=2
    )
    fly.run(source, how)
    spent = measure_cpu_s(lambda: label.run(source, out, label.Settings()))
    pairs = robots * (robots - 1)
    what = f"{robots} robots, {duration_s:g} s, seed {seed}"
    return [
        ("label, cpu-s per flight", what, spent),
        ("label, cpu-ms per directed pair and second", what, 1e3 * spent / pairs / duration_s),
        ("recording with images, MB", what, source.stat().st_size / 1e6),
    ]


def measure_datasets(folder: Path) -> list[Row]:
    """Make datasets of the labelled flights, with raw and PNG images; return their costs."""
    given = sorted(folder.glob("*-labels.mcap"))
    rows: list[Row] = []
    for png in (False, True):
        out = folder / f"set-{png}"
        how = dataset.Settings(keep_all=True, png=png)
        spent = measure_cpu_s(lambda out=out, how=how: dataset.run(given, out, how, workers=1))  # type: ignore[misc]
        opened = open_dataset(out)
        count = sum(len(opened.split(name)) for name in opened.splits)
        size = sum(path.stat().st_size for path in out.rglob("*.arrow"))
        what = f"{count} images of 320 x 224 px, {'PNG' if png else 'raw'}"
        rows += [("dataset, cpu-ms per image", what, 1e3 * spent / count)]
        rows += [("dataset, kB per image", what, size / count / 1e3)]
    return rows


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "first").mkdir()
        measure_labelling(folder / "first", 2, 6.0, 9)  # a warm-up: imports and caches
        rows = []
        for robots, duration_s, seed in ((2, 20, 0), (2, 20, 1), (2, 60, 2), (4, 20, 3)):
            rows += measure_labelling(folder, robots, duration_s, seed)
        rows += measure_datasets(folder)
    print_table("", ("cost", "input", "value"), sorted(rows))


if __name__ == "__main__":
    main()
