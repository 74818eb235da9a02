"""Judge labels: flights without a fault, with 96 injected ones, with cameras, and real ones.

Run as ``make bench-labels``, or ``python benchmarks/bench_label_judge.py FOLDER [--state
NAME=COMMAND ...] [--sets sound faults thirds eyes real] [--noise calibrated] [--flights 5]
[--only PATTERN] [--data DIR] [--json FILE]``. FOLDER keeps the flights, which are made once, and
the figures of each flight by state: what is there is not run again. A state is a command that runs
some checkout's dmrl; without one, this environment's counts.

Faults are injected into recordings of sound flights. Errors are horizontal, of all positions,
kept or not, from the first second. DIR holds ``nanobench`` and ``uwb-tiers``.
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
from label_judge.faults import ROWS
from label_judge.figures import FlightFigures, RowFigures, combine, judge_flight
from label_judge.jobs import NOISES, SETS, Job, list_jobs

FOLDER_SIZE = 10
"""Recordings of one run of the command."""


def label(command: str, jobs: Sequence[Job], folder: Path) -> dict[str, FlightFigures]:
    """Label some flights by a command, as a folder, and judge them."""
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
    """Read the figures that a state has already."""
    if not path.exists():
        return {}
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return {row.pop("key"): FlightFigures(**row) for row in rows}


def run_state(
    name: str, command: str, jobs: Sequence[Job], folder: Path, data: Path | None
) -> dict[str, FlightFigures]:
    """Label the flights that a state has no figures of yet."""
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
    """Folders of recordings with the same flags."""
    for options in dict.fromkeys(job.options for job in jobs):
        same = [job for job in jobs if job.options == options]
        for first in range(0, len(same), FOLDER_SIZE):
            yield tuple(same[first : first + FOLDER_SIZE])


HEAD = (
    f"{'row':<34}{'noise':<11}{'state':<9}{'n':>3}{'RMSE':>7}{'sigma':>7}{'bound':>7}{'R/b':>6}"
    f"{'s/b':>6}{'in 95':>7}{'kept':>6}{'/limit':>7}{'/sound':>7}{'bad':>7}{'worst':>7}{'said':>6}"
    f"{'near':>6}{'fail':>5}{'cpu-s':>7}"
)


def print_row(row: str, noise: str, state: str, f: RowFigures) -> None:
    """Print a line of the table."""

    def share(value: float, digits: int = 0) -> str:
        return "-" if np.isnan(value) else f"{value:.{digits}%}"

    def metres(value: float) -> str:
        return "-" if np.isnan(value) else f"{value:.3f}"

    def ratio(value: float) -> str:
        return "-" if np.isnan(value) else f"{value:.2f}"

    print(
        f"{row[:33]:<34}{noise:<11}{state[:8]:<9}{f.flights:>3}{metres(f.rmse_m):>7}"
        f"{metres(f.sigma_m):>7}{metres(f.bound_m):>7}{ratio(f.rmse_m / f.bound_m):>6}"
        f"{ratio(f.sigma_m / f.bound_m):>6}{share(f.ellipse, 1):>7}{share(f.kept):>6}"
        f"{ratio(f.kept_of_limit):>7}{ratio(f.kept_of_sound):>7}{share(f.bad, 1):>7}"
        f"{share(f.worst, 1):>7}{share(f.said):>6}{share(f.near):>6}{f.failed:>5}{f.cpu_s:>7.2f}"
    )


def build_table(
    jobs: Sequence[Job], states: dict[str, dict[str, FlightFigures]]
) -> list[dict[str, Any]]:
    """Build and print the table: a line for each row, noise and state."""
    table = []
    print(HEAD)
    for kind, row, noise in dict.fromkeys((job.kind, job.row, job.noise) for job in jobs):
        mine = [job for job in jobs if (job.kind, job.row, job.noise) == (kind, row, noise)]
        for state, figures in states.items():
            sound = [figures.get(f"{kind}-none-{noise}-{job.number}") for job in mine]
            done = [figures[job.key] for job in mine]
            made = combine(done, mine[0].cause, [f for f in sound if f is not None])
            print_row(row, noise, state, made)
            table.append({"set": kind, "row": row, "noise": noise, "state": state, **asdict(made)})
    return table


def summarise(table: Sequence[dict[str, Any]]) -> None:
    """Print how many rows of faults are honest, and how many have their cause named."""
    limits = {"calibrated": (0.01, 0.05), "realistic": (0.02, 0.10)}
    for kind in ("faults", "thirds"):
        for state in dict.fromkeys(line["state"] for line in table):
            mine = [
                line
                for line in table
                if (line["set"], line["state"]) == (kind, state) and line["row"] != "none"
            ]
            if not mine:
                continue
            wrong = {
                line["row"]
                for line in mine
                if line["kept"] > 0.01
                and (
                    line["bad"] > limits[line["noise"]][0]
                    or line["worst"] > limits[line["noise"]][1]
                )
            }
            rows = dict.fromkeys(line["row"] for line in mine)
            caused = {row.name for row in ROWS if row.cause}
            told = [line for line in mine if line["row"] in caused]
            near = np.mean([line["near"] >= 0.5 for line in told]) if told else float("nan")
            print(
                f"{kind}, {state}: {len(rows) - len(wrong)} of {len(rows)} rows are honest or "
                f"refused; a cause near the true one in {near:.0%} of the lines"
            )


def main() -> None:
    """Run the states and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--state", action="append", default=[], help="NAME=COMMAND, repeatable")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=["sound", "faults"])
    parser.add_argument("--noise", nargs="+", choices=NOISES, default=list(NOISES))
    parser.add_argument("--flights", type=int, default=5, help="of each row")
    parser.add_argument("--only", help="pattern of rows")
    parser.add_argument("--data", type=Path, help="folder of nanobench and uwb-tiers")
    parser.add_argument("--json", type=Path, help="write the table there too")
    given = parser.parse_args()
    here = f"{shlex.quote(sys.executable)} -m dmrl"
    commands = dict(text.split("=", 1) for text in given.state) or {"here": here}
    given.folder.mkdir(parents=True, exist_ok=True)
    jobs = list_jobs(given.sets, given.flights, given.noise, given.only or "", given.data)
    states = {
        name: run_state(name, command, jobs, given.folder, given.data)
        for name, command in commands.items()
    }
    table = build_table(jobs, states)
    summarise(table)
    if given.json:
        given.json.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
