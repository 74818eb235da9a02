"""Evaluate labels of flights without faults, with injected faults, with cameras, and real flights.

Run as ``make bench-labels``, or ``python benchmarks/bench_label_judge.py FOLDER [--state
NAME=COMMAND ...] [--sets sound faults thirds unlisted eyes real] [--noise calibrated] [--flights 5]
[--only PATTERN] [--data DIR] [--json FILE]``. FOLDER keeps the flights and the figures of each
flight by state; a later run computes only what is missing. A state is a version of dmrl: a name
and the command that runs it. By default it is the dmrl of this environment.

Faults are injected into recordings of sound flights. Errors are horizontal, and count for all
positions from the first second, whether kept or not. DIR holds ``nanobench`` and ``uwb-tiers``.
"""

import argparse
import json
import os
import resource
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from label_judge import real
from label_judge.figures import FlightFigures, RowFigures, combine, judge_flight
from label_judge.jobs import NOISES, SETS, Job, list_jobs, shift_seeds

FOLDER_SIZE = 10
"""Largest number of recordings in one run of the command."""


def label(command: str, jobs: Sequence[Job], folder: Path) -> dict[str, FlightFigures]:
    """Label a folder with some flights by a command, and evaluate the labels."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        here, out = Path(place) / "in", Path(place) / "out"
        here.mkdir()
        for job in jobs:
            os.link(folder / "flights" / f"{job.key}.mcap", here / f"{job.key}.mcap")
        words = [*shlex.split(command), "label", here, out, "--json", "--workers", "1"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [*words, *jobs[0].options],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        try:
            told = {Path(r["recording"]).stem: r for r in json.loads(done.stdout)["recordings"]}
        except (ValueError, KeyError):
            told = {job.key: {"error": done.stderr.strip()[-300:] or "no output"} for job in jobs}
        made = {}
        for job in jobs:
            beside = folder / "flights" / f"{job.key}.npz"
            moving = real.MOVING if job.row == "TIERS" else ()
            figures = judge_flight(
                out / f"{job.key}.mcap",
                beside if beside.exists() else None,
                told.get(job.key, {"error": "not mentioned"}),
                moving,
            )
            made[job.key] = FlightFigures(**{**asdict(figures), "cpu_s": spent_s / len(jobs)})
        return made


def read_figures(path: Path) -> dict[str, FlightFigures]:
    """Return the stored figures of a state, by key of the flight; empty if there are none."""
    if not path.exists():
        return {}
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return {row.pop("key"): FlightFigures(**row) for row in rows}


def run_state(
    name: str, command: str, jobs: Sequence[Job], folder: Path, data: Path | None
) -> dict[str, FlightFigures]:
    """Label and evaluate the flights that have no figures of this state; return all figures."""
    path = folder / f"{name}.jsonl"
    have = read_figures(path)
    missing = [job for job in jobs if job.key not in have]
    missing.sort(key=lambda job: job.options)
    (folder / "flights").mkdir(parents=True, exist_ok=True)
    for some in _split(missing):
        for job in some:
            target = folder / "flights" / f"{job.key}.mcap"
            if not target.exists():
                job.make(target, data)
        made = label(command, some, folder)
        have |= made
        with path.open("a") as stream:
            for key, figures in made.items():
                stream.write(json.dumps({"key": key, **asdict(figures)}) + "\n")
        print(f"{name}: {len(have)} flights", file=sys.stderr, flush=True)
    return have


def _split(jobs: Sequence[Job]) -> Iterator[tuple[Job, ...]]:
    """Yield groups of at most `FOLDER_SIZE` jobs with equal options of `dmrl label`."""
    for options in dict.fromkeys(job.options for job in jobs):
        same = [job for job in jobs if job.options == options]
        for first in range(0, len(same), FOLDER_SIZE):
            yield tuple(same[first : first + FOLDER_SIZE])


HEAD = (
    f"{'row':<34}{'noise':<11}{'state':<9}{'n':>3}{'RMSE':>7}{'sigma':>7}{'bound':>7}{'R/b':>6}"
    f"{'s/b':>6}{'in 95':>7}{'least':>7}{'kept':>6}{'/limit':>7}{'/sound':>7}{'bad':>7}{'worst':>7}"
    f"{'said':>6}{'near':>6}{'fail':>5}{'cpu-s':>7}"
)
"""R/b and s/b: median RMSE and stated sigma over the bound; least: smallest share in the ellipse.

/limit and /sound: positions kept, over those that the bound allows and those of a sound flight.
"""


def print_row(row: str, noise: str, state: str, f: RowFigures) -> None:
    """Print a line of the table."""

    def fill(value: float, form: str, width: int) -> str:
        return f"{'-' if np.isnan(value) else format(value, form):>{width}}"

    cells = (
        (f.rmse_m, ".3f", 7),
        (f.sigma_m, ".3f", 7),
        (f.bound_m, ".3f", 7),
        (f.ratio, ".2f", 6),
        (f.sigma_m / f.bound_m, ".2f", 6),
        (f.ellipse, ".1%", 7),
        (f.least_ellipse, ".0%", 7),
        (f.kept, ".0%", 6),
        (f.kept_of_limit, ".2f", 7),
        (f.kept_of_sound, ".2f", 7),
        (f.bad, ".1%", 7),
        (f.worst, ".1%", 7),
        (f.said, ".0%", 6),
        (f.near, ".0%", 6),
        (f.failed, "d", 5),
        (f.cpu_s, ".2f", 7),
    )
    words = f"{row[:33]:<34}{noise:<11}{state[:8]:<9}{f.flights:>3}"
    print(words + "".join(fill(*cell) for cell in cells))


def build_table(
    jobs: Sequence[Job], states: dict[str, dict[str, FlightFigures]]
) -> list[dict[str, Any]]:
    """Print a line for each row, noise and state; return them for JSON."""
    table = []
    print(HEAD)
    for kind, row, noise in dict.fromkeys((job.kind, job.row, job.noise) for job in jobs):
        mine = [job for job in jobs if (job.kind, job.row, job.noise) == (kind, row, noise)]
        for state, figures in states.items():
            sound = [figures.get(f"{kind}-none-{noise}-{job.number}") for job in mine]
            done = [figures[job.key] for job in mine if job.key in figures]
            if not done:
                continue
            cause = mine[0].cause
            made = combine(done, cause, [f for f in sound if f is not None])
            print_row(row, noise, state, made)
            names = {"set": kind, "row": row, "noise": noise, "state": state, "cause": cause}
            table.append({**names, **asdict(made)})
    return table


HONEST = {"calibrated": (0.01, 0.05), "realistic": (0.02, 0.10)}
"""Largest share of kept positions that may be bad, over all flights and in the worst flight."""
MIN_KEPT, MIN_KEPT_OF_SOUND = 0.01, 0.6
"""Kept share below which a row counts as refused; share of the positions kept without the fault."""


def summarise(table: Sequence[dict[str, Any]]) -> None:
    """Print in how many lines of faults the labels are honest, useful, and name the cause."""
    lines = [line for line in table if line["set"] in ("faults", "thirds", "unlisted")]
    for kind, state in dict.fromkeys((line["set"], line["state"]) for line in lines):
        mine = [line for line in lines if (line["set"], line["state"]) == (kind, state)]
        mine = [line for line in mine if line["row"] != "none"]
        honest = [
            line["kept"] < MIN_KEPT
            or (
                line["bad"] <= HONEST[line["noise"]][0]
                and line["worst"] <= HONEST[line["noise"]][1]
            )
            for line in mine
        ]
        useful = [line["kept_of_sound"] >= MIN_KEPT_OF_SOUND for line in mine]
        told = [line["near"] >= 0.5 for line in mine if line["cause"]]
        print(
            f"{kind}, {state}: of {len(mine)} lines (row and noise) {sum(honest)} are honest or "
            f"refused, and {sum(useful)} keep {MIN_KEPT_OF_SOUND:.0%} of a sound flight; of "
            f"{len(told)} lines with a cause, {sum(told)} name it"
        )


def main() -> None:
    """Label the flights with each state, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--state", action="append", default=[], help="NAME=COMMAND, repeatable")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=["sound", "faults"])
    parser.add_argument("--noise", nargs="+", choices=NOISES, default=list(NOISES))
    parser.add_argument("--flights", type=int, default=5, help="flights per row")
    parser.add_argument("--only", help="pattern of rows")
    parser.add_argument(
        "--seed-shift", type=int, default=0, help="added to all seeds; use another FOLDER for each"
    )
    parser.add_argument("--data", type=Path, help="folder with nanobench and uwb-tiers")
    parser.add_argument("--no-run", action="store_true", help="print the stored figures only")
    parser.add_argument("--json", type=Path, help="also write the table to this file")
    given = parser.parse_args()
    here = f"{shlex.quote(sys.executable)} -m dmrl.cli"
    commands = dict(text.split("=", 1) for text in given.state) or {"here": here}
    given.folder.mkdir(parents=True, exist_ok=True)
    jobs = list_jobs(given.sets, given.flights, given.noise, given.only or "", given.data)
    jobs = shift_seeds(jobs, given.seed_shift)
    states = {
        name: read_figures(given.folder / f"{name}.jsonl")
        if given.no_run
        else run_state(name, command, jobs, given.folder, given.data)
        for name, command in commands.items()
    }
    table = build_table(jobs, states)
    summarise(table)
    if given.json:
        given.json.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
