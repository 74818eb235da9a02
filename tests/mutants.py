"""Small wrong changes to a room's code, and whether the tests of that room notice.

    make mutants ARGS="geometry labelling --count 30 --seed 1"

Draws changes by a seed, each kind as often as the others, makes one at a time in a copy of the
tree, and runs the room's tests that run the changed line until one fails: those of the module
first, then the quickest. What no test noticed is printed; ``--out`` keeps all.

    make mutants ARGS="--named"

makes the changes of ``mutants.toml``, which people thought of, each against the tests named there.

With ``--quick`` nobody measures which tests run a line: those of the module and those that name it
are run. That takes a tenth of the time; what they let pass another test may notice.
"""

import argparse
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import NoReturn

import pytest
from coverage import Coverage, CoverageData
from mutations import REPOSITORY, Mutant, drawn, files_of, named, near, room_of

ROOMS = ("geometry", "estimation", "labelling", "learn", "recording", "formats", "deploy")
BESIDE = ("viewer", "schemas", "recipes")
"""Folders at the top that are imported as parts of dmrl."""
HEAVY = ("scipy.stats", "scipy.optimize", "pyarrow.compute", "PIL.Image")
HEAVY += ("filterpy.kalman", "mcap.writer", "cv2", "torch", "tensorboard", "onnx", "onnxruntime")
HEAVY += ("hypothesis.strategies", "hypothesis.extra.numpy")
"""What tests import and changes do not touch: imported once, for the tests of every change."""
Row = dict[str, object]
"""A change, the tests that may notice, and whether they did."""
LEAST_S = 120.0
"""Tests that run for longer than this, and than ten times what they should, do not end."""


class Copy:
    """A copy of the tree, in which a room's tests run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        names = subprocess.run(listed, cwd=REPOSITORY, check=True, capture_output=True).stdout
        for name in filter(None, names.decode().split("\0")):
            if (REPOSITORY / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(REPOSITORY / name, folder / name)
        for name in BESIDE:  # as they are installed
            (folder / "dmrl" / name).symlink_to(folder / name)
        data = REPOSITORY.parent / "shared" / "data"
        self.env = {"DMRL_DATA": os.environ.get("DMRL_DATA", str(data)), "OMP_NUM_THREADS": "1"}
        self.env |= {"PYTHONPATH": str(folder), "TMPDIR": str(folder / "tmp")}
        (self.folder / "tmp").mkdir()
        self.quietly = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:anyio"]
        self.quietly += ["-m", "not slow", "--basetemp", str(folder / "tmp" / "pytest")]
        self.quietly += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]

    def pytest(self, tests: list[str], limit_s: float) -> int | None:
        """Exit status of pytest up to its first failure; None where it did not end."""
        child = os.fork()
        if child == 0:
            self._become_pytest(["-x", *self.quietly, *tests])
        until = time.monotonic() + limit_s
        while (ended := os.waitpid(child, os.WNOHANG))[0] == 0 and time.monotonic() < until:
            time.sleep(0.05)
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # and what its tests have left
        if ended[0] == 0:
            os.waitpid(child, 0)
        shutil.rmtree(self.folder / "tmp", ignore_errors=True)
        (self.folder / "tmp").mkdir()
        return os.waitstatus_to_exitcode(ended[1]) if ended[0] else None

    def _become_pytest(self, words: list[str]) -> NoReturn:
        os.setsid()
        os.chdir(self.folder)
        os.environ.update(self.env)
        sys.path[:0] = [str(self.folder)]
        sys.dont_write_bytecode = False  # else all is compiled again for every change
        log = os.open("pytest.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(log, stream)
        status = 1
        try:
            status = int(pytest.main(words))
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        os._exit(status)

    def lines(self, room: str) -> tuple[CoverageData, dict[str, float]]:
        """Which tests of a room run which lines of it, and how long each takes. All pass."""
        data = self.folder / f"{room}.coverage"
        command = [sys.executable, "-m", "coverage", "run", f"--data-file={data}"]
        command += [f"--source={self.folder / 'dmrl' / room}", "-m", "pytest", "-x"]
        command += [*self.quietly, "-p", "mutants", f"tests/{room}"]
        path = os.pathsep.join([str(self.folder), str(self.folder / "tests")])
        took = self.folder / f"{room}.json"
        env = {**os.environ, **self.env, "PYTHONPATH": path, "MUTANTS_TOOK": str(took)}
        env.pop("PYTHONDONTWRITEBYTECODE", None)
        done = subprocess.run(command, cwd=self.folder, env=env, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{done.stdout}{done.stderr}tests/{room} fail as they are")
        found = CoverageData(str(data))
        found.read()
        return found, json.loads(took.read_text())

    def survives(self, mutant: Mutant, tests: list[str], limit_s: float) -> bool:
        """Whether the tests pass with a change."""
        path = self.folder / mutant.path
        source = path.read_bytes()
        path.write_bytes(source[: mutant.start] + mutant.after.encode() + source[mutant.end :])
        # Python takes a compiled file for that of another change if size and time are the same.
        os.utime(path, (mutant.start, mutant.start + len(mutant.after)))
        try:
            return self.pytest(tests, limit_s) == 0
        finally:
            path.write_bytes(source)


TOOK: dict[str, float] = {}


def pytest_runtest_logstart(nodeid: str) -> None:
    """As a plug-in of pytest: lines that run from here on are of this test."""
    running = Coverage.current()
    if running is not None:
        running.switch_context(nodeid)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """How long a test took, with what it stands on."""
    TOOK[report.nodeid] = TOOK.get(report.nodeid, 0.0) + report.duration


def pytest_sessionfinish() -> None:
    """Written where it is asked for."""
    if "MUTANTS_TOOK" in os.environ:
        Path(os.environ["MUTANTS_TOOK"]).write_text(json.dumps(TOOK))


def tests_of(
    mutant: Mutant, lines: CoverageData, took: Mapping[str, float], folder: Path
) -> list[str]:
    """Tests that may notice: the module's own first, then the quickest."""
    measured = {Path(name).resolve(): name for name in lines.measured_files()}
    name = measured.get((folder / mutant.path).resolve())
    by_line = lines.contexts_by_lineno(name) if name else {}
    rows = range(mutant.line, mutant.line + mutant.before.count("\n") + 1)
    found = {test for row in rows for test in by_line.get(row, ())}
    if "" in found:  # runs when the module is imported
        found = set(took)
    own = f"/test_{Path(mutant.path).stem}.py::"
    return sorted(found & took.keys(), key=lambda test: (own not in test, took[test], test))


def quickly(copy: Copy, room: str, mutants: list[Mutant]) -> Iterator[Row]:
    """Each change, and whether the tests near it noticed."""
    began = time.monotonic()
    if copy.pytest([f"tests/{room}"], 10 * LEAST_S):
        sys.exit((copy.folder / "pytest.log").read_text() + f"tests/{room} fail as they are")
    limit_s = max(LEAST_S, 10 * (time.monotonic() - began))
    for mutant in mutants:
        yield _row(mutant, near(mutant), copy.survives(mutant, near(mutant), limit_s))


def measured(copy: Copy, room: str, mutants: list[Mutant]) -> Iterator[Row]:
    """Each change, and whether it was noticed; those that were not are printed."""
    lines, took = copy.lines(room)
    if copy.pytest([str(files_of(room)[0].relative_to(REPOSITORY))], 10 * LEAST_S):
        sys.exit((copy.folder / "pytest.log").read_text() + "no test passes after a fork")
    for mutant in mutants:
        tests = tests_of(mutant, lines, took, copy.folder)
        limit_s = max(LEAST_S, 10 * sum(took[test] for test in tests))
        yield _row(mutant, tests, not tests or copy.survives(mutant, tests, limit_s))


def by_hand(copy: Copy, rooms: tuple[str, ...]) -> Iterator[Row]:
    """The same of the changes made by hand."""
    changes, gone = named(rooms)
    for line in gone:
        print(line, flush=True)
    limits_s = {}
    for tests in sorted({tests for _, tests in changes}):
        began = time.monotonic()
        if copy.pytest(list(tests), 10 * LEAST_S):
            sys.exit((copy.folder / "pytest.log").read_text() + f"{tests} fail as they are")
        limits_s[tests] = max(LEAST_S, 10 * (time.monotonic() - began))
    for mutant, tests in changes:
        yield _row(mutant, tests, copy.survives(mutant, list(tests), limits_s[tests]))


def _row(mutant: Mutant, tests: Sequence[str], survived: bool) -> Row:
    if survived:
        print(f"{mutant.path}:{mutant.line}: {mutant.kind}, {len(tests)} tests run it")
        print(f"  - {' '.join(mutant.before.split())}\n  + {mutant.after}", flush=True)
    room = room_of(mutant.path) or "top"
    return {"room": room, "survived": survived, "tests": list(tests), **asdict(mutant)}


def _tried(given: argparse.Namespace, copy: Copy) -> Iterator[Row]:
    """Each change that is asked for, and whether it was noticed."""
    if given.named:
        yield from by_hand(copy, tuple(given.rooms))
        return
    alive = None
    if given.again:
        kept = json.loads(given.again.read_text())["mutants"]
        alive = {(m["path"], m["before"], m["after"]) for m in kept if m["survived"]}
    for room in given.rooms or ROOMS:
        chosen = drawn(room, given.count, given.seed, tuple(given.without))
        if alive is not None:
            chosen = [m for m in chosen if (m.path, m.before, m.after) in alive]
        yield from (quickly if given.quick else measured)(copy, room, chosen)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("rooms", nargs="*", help=f"of {', '.join(ROOMS)}; without any, all")
    parser.add_argument("--named", action="store_true", help="the changes of mutants.toml")
    parser.add_argument("--count", type=int, default=30, help="changes of each room")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without", action="append", default=[], help="a module to leave alone")
    parser.add_argument("--quick", action="store_true", help="only tests that name the module")
    parser.add_argument("--again", type=Path, help="only what survived by this file of --out")
    parser.add_argument("--out", type=Path, help="where to keep every change, as JSON")
    given = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in HEAVY:
        importlib.import_module(name)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        for row in _tried(given, Copy(Path(folder).resolve())):
            rows.append(row)
            if given.out:  # after each, so that what was stopped tells how far it came
                kept = {"seed": given.seed, "mutants": rows}
                given.out.write_text(json.dumps(kept, indent=1))
    for room in dict.fromkeys(row["room"] for row in rows):
        count = Counter(row["survived"] for row in rows if row["room"] == room)
        share = count[False] / max(count.total(), 1)
        print(f"{room}: {count[False]} of {count.total()} noticed, {share:.0%}")


if __name__ == "__main__":
    main()
