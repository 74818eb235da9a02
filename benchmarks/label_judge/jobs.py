"""Flights of the benchmark: motion, injected fault, and options of `dmrl label`."""

import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from label_judge import real
from label_judge.faults import ROWS
from label_judge.flights import HOPS, MOTIONS, Base, Eye, fly, look, write
from label_judge.injection import Row
from label_judge.unlisted_rows import UNLISTED_ROWS

SETS = ("sound", "faults", "thirds", "unlisted", "eyes", "real")
NOISES = ("calibrated", "realistic")
FIRST_SEED = {"sound": 7100, "faults": 8100, "thirds": 8100, "unlisted": 8600, "eyes": 9100}


@dataclass(frozen=True)
class Job:
    """One flight to label.

    Parameters
    ----------
    kind, row, noise, number
        Set, name of the row, noise preset, and number of the flight in the row.
    base
        The simulated flight; None for a real one.
    fault
        Injected fault.
    eye, ranges
        Errors of the detectors, and whether the recording has ranges.
    options
        Further options of `dmrl label`.
    cause
        Regular expression that matches a correct name of the cause.
    """

    kind: str
    row: str
    noise: str
    number: int
    base: Base | None = None
    fault: Row | None = None
    eye: Eye | None = None
    ranges: bool = True
    options: tuple[str, ...] = ()
    cause: str = ""

    @property
    def key(self) -> str:
        """Return the stem of the flight's files; it also seeds the fault."""
        row = re.sub(r"\W+", "-", self.row).strip("-")
        return f"{self.kind}-{row}-{self.noise}-{self.number}"

    def make(self, path: Path, data: Path | None) -> None:
        """Write the recording of the flight."""
        if self.base is None:
            assert data is not None
            real.write_real(self.row, self.number, data, path)
            return
        logs, rng = fly(self.base), np.random.default_rng(zlib.crc32(self.key.encode()))
        if self.fault is not None:
            self.fault.inject(logs, self.fault.size, rng)
        if self.eye is not None:
            look(logs, self.eye, rng)
            logs.bound = {}  # the bound does not include detections
        if not self.ranges:
            logs.ranges.clear()
        write(logs, self.base, {"row": self.row}, path)


def list_sound(flights: int, noises: Sequence[str]) -> Iterator[Job]:
    """Yield flights without a fault."""
    seed = FIRST_SEED["sound"]
    for noise in noises:
        for motion in (*MOTIONS, HOPS):
            for k in range(flights):
                base = Base(motion, noise, 100.0, seed + k)
                yield Job("sound", f"{motion} 100 s", noise, k, base)
        for k in range(flights):
            base = Base(MOTIONS[k % 3], noise, 20.0, seed + 100 + k)
            yield Job("sound", "all motions 20 s", noise, k, base)
    for k in range(flights):
        base = Base(MOTIONS[k % 3], "harsh", 100.0, seed + 200 + k)
        yield Job("sound", "all motions 100 s", "harsh", k, base)


def list_faults(kind: str, flights: int, noises: Sequence[str]) -> Iterator[Job]:
    """Yield flights with one injected fault each, and the same flights without a fault."""
    none = Row("none", lambda logs, size, rng: None, 0.0, "")
    rows = {"faults": ROWS, "unlisted": UNLISTED_ROWS}.get(
        kind, tuple(row.shrunk for row in ROWS if row.size)
    )
    for noise in noises:
        for row in (none, *rows):
            for k in range(flights):
                motion = MOTIONS[k % 3]
                base = Base(motion, noise, 100.0, FIRST_SEED[kind] + k, row.motion)
                yield Job(kind, row.name, noise, k, base, row, cause=row.cause)


EYES = {
    "ideal camera": (Eye(), False),
    "lasting errors": (Eye(lasting_share=0.2, unseen_share=0.3), False),
    "half of the images wrong": (Eye(wrong=0.5), False),
    "ideal camera and ranges": (Eye(), True),
    "depths 10 % too large, and ranges": (Eye(too_far=0.1), True),
}


def list_eyes(flights: int, noises: Sequence[str]) -> Iterator[Job]:
    """Yield flights in view with camera detections."""
    for noise in noises:
        for name, (eye, ranges) in EYES.items():
            for k in range(flights):
                base = Base("in_view", noise, 100.0, FIRST_SEED["eyes"] + k)
                options = ("--detections",)
                yield Job("eyes", name, noise, k, base, None, eye, ranges, options)


def list_jobs(
    sets: Sequence[str], flights: int, noises: Sequence[str], only: str, data: Path | None
) -> list[Job]:
    """Return the flights of some sets.

    Parameters
    ----------
    sets
        Some of `SETS`.
    flights
        Number of flights per row.
    noises
        Some of `NOISES`.
    only
        Regular expression that selects rows.
    data
        Folder of real flights; None: no real flights.
    """
    jobs: list[Job] = []
    for kind in sets:
        if kind == "sound":
            jobs += list_sound(flights, noises)
        elif kind in ("faults", "thirds", "unlisted"):
            jobs += list_faults(kind, flights, noises)
        elif kind == "eyes":
            jobs += list_eyes(flights, noises)
        elif data is not None:
            pairs = range(real.count_pairs(data))
            jobs += [Job("real", "nanobench pair", "real", k) for k in pairs]
            jobs.append(
                Job("real", "TIERS", "real", 0, options=("--range-offset-m", str(real.OFFSET_M)))
            )
    wanted = re.compile(only, re.IGNORECASE)
    return [job for job in jobs if wanted.search(job.row) or job.row == "none"]


def shift_seeds(jobs: Sequence[Job], shift: int) -> list[Job]:
    """Return the same jobs with shifted seeds of the simulated flights."""
    return [
        replace(job, base=job.base and replace(job.base, seed=job.base.seed + shift))
        for job in jobs
    ]
