"""Mutation testing: make small wrong changes to a package's code and run its tests.

    make mutants ARGS="geometry labelling --count 30 --seed 1"

draws changes by a seed, each kind equally often, and makes one at a time in a copy of the tree.
It runs those tests of the package that execute the changed line, until one fails: the tests of the
module first, then the fastest. Changes that no test detects are printed; ``--out`` saves all.

    make mutants ARGS="--named"

makes the hand-written changes of ``mutants.toml`` and runs the tests that are named there.

``--quick`` does not measure which tests execute a line. It runs the tests of the module and those
that name it, in a tenth of the time. Another test may detect a change that it reports.
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
from mutations import (
    REPOSITORY,
    Mutant,
    draw_mutants,
    find_room,
    find_tests,
    list_test_files,
    load_named_mutants,
)

ROOMS = ("geometry", "estimation", "labelling", "learn", "recording", "formats", "deploy")
BESIDE = ("viewer", "schemas", "recipes")
"""Top-level folders that are installed as subpackages of dmrl."""
HEAVY = ("scipy.stats", "scipy.optimize", "pyarrow.compute", "PIL.Image")
HEAVY += ("filterpy.kalman", "mcap.writer", "cv2", "torch", "tensorboard", "onnx", "onnxruntime")
HEAVY += ("hypothesis.strategies", "hypothesis.extra.numpy")
"""Packages that are imported once, before the process forks for the tests of each change."""
Row = dict[str, object]
"""A change, the tests that were run, and whether all of them passed."""
LEAST_S = 120.0
"""Tests count as hung after this time or ten times their normal time, whichever is longer."""


class Copy:
    """A copy of the tree in which the tests run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        names = subprocess.run(listed, cwd=REPOSITORY, check=True, capture_output=True).stdout
        for name in filter(None, names.decode().split("\0")):
            if (REPOSITORY / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(REPOSITORY / name, folder / name)
        for name in BESIDE:  # the layout of an installed package
            (folder / "dmrl" / name).symlink_to(folder / name)
        data = REPOSITORY.parent / "shared" / "data"
        self.env = {"DMRL_DATA": os.environ.get("DMRL_DATA", str(data)), "OMP_NUM_THREADS": "1"}
        self.env |= {"PYTHONPATH": str(folder), "TMPDIR": str(folder / "tmp")}
        (self.folder / "tmp").mkdir()
        self.options = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:anyio"]
        self.options += ["-m", "not slow", "--basetemp", str(folder / "tmp" / "pytest")]
        self.options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]

    def run_pytest(self, tests: list[str], limit_s: float) -> int | None:
        """Run tests up to the first failure; return the exit status, or None after ``limit_s``."""
        child = os.fork()
        if child == 0:
            self._become_pytest(["-x", *self.options, *tests])
        until = time.monotonic() + limit_s
        while (ended := os.waitpid(child, os.WNOHANG))[0] == 0 and time.monotonic() < until:
            time.sleep(0.05)
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # also ends processes that its tests left running
        if ended[0] == 0:
            os.waitpid(child, 0)
        shutil.rmtree(self.folder / "tmp", ignore_errors=True)
        (self.folder / "tmp").mkdir()
        return os.waitstatus_to_exitcode(ended[1]) if ended[0] else None

    def _become_pytest(self, words: list[str]) -> NoReturn:
        """Run pytest in this forked process, log its output, and exit with its status."""
        os.setsid()
        os.chdir(self.folder)
        os.environ.update(self.env)
        sys.path[:0] = [str(self.folder)]
        sys.dont_write_bytecode = False  # avoids compiling every module again for each change
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

    def measure_lines(self, room: str) -> tuple[CoverageData, dict[str, float]]:
        """Return which tests of a package execute which lines, and the seconds each test takes.

        Exit if a test fails.
        """
        data = self.folder / f"{room}.coverage"
        command = [sys.executable, "-m", "coverage", "run", f"--data-file={data}"]
        command += [f"--source={self.folder / 'dmrl' / room}", "-m", "pytest", "-x"]
        command += [*self.options, "-p", "mutants", f"tests/{room}"]
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
        """Return whether the tests pass with a change."""
        path = self.folder / mutant.path
        source = path.read_bytes()
        path.write_bytes(source[: mutant.start] + mutant.after.encode() + source[mutant.end :])
        # Python reuses a compiled file whose source has the same size and time. The time is
        # therefore made different for each change.
        os.utime(path, (mutant.start, mutant.start + len(mutant.after)))
        try:
            return self.run_pytest(tests, limit_s) == 0
        finally:
            path.write_bytes(source)


TOOK: dict[str, float] = {}


def pytest_runtest_logstart(nodeid: str) -> None:
    """Attribute the lines that are executed from here on to this test (pytest hook)."""
    running = Coverage.current()
    if running is not None:
        running.switch_context(nodeid)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add up the time of a test with its fixtures (pytest hook)."""
    TOOK[report.nodeid] = TOOK.get(report.nodeid, 0.0) + report.duration


def pytest_sessionfinish() -> None:
    """Write the times of the tests to the file that the environment names (pytest hook)."""
    if "MUTANTS_TOOK" in os.environ:
        Path(os.environ["MUTANTS_TOOK"]).write_text(json.dumps(TOOK))


def select_tests(
    mutant: Mutant, lines: CoverageData, took: Mapping[str, float], folder: Path
) -> list[str]:
    """Return the tests that execute the changed lines: those of the module first, then by time."""
    measured = {Path(name).resolve(): name for name in lines.measured_files()}
    name = measured.get((folder / mutant.path).resolve())
    by_line = lines.contexts_by_lineno(name) if name else {}
    rows = range(mutant.line, mutant.line + mutant.before.count("\n") + 1)
    found = {test for row in rows for test in by_line.get(row, ())}
    if "" in found:  # the line is executed on import, so that every test may depend on it
        found = set(took)
    own = f"/test_{Path(mutant.path).stem}.py::"
    return sorted(found & took.keys(), key=lambda test: (own not in test, took[test], test))


def try_without_coverage(copy: Copy, room: str, mutants: list[Mutant]) -> Iterator[Row]:
    """Make each change and run the tests of the module and those that name it."""
    began = time.monotonic()
    if copy.run_pytest([f"tests/{room}"], 10 * LEAST_S):
        sys.exit((copy.folder / "pytest.log").read_text() + f"tests/{room} fail as they are")
    limit_s = max(LEAST_S, 10 * (time.monotonic() - began))
    for mutant in mutants:
        tests = find_tests(mutant)
        yield _report(mutant, tests, copy.survives(mutant, tests, limit_s))


def try_with_coverage(copy: Copy, room: str, mutants: list[Mutant]) -> Iterator[Row]:
    """Make each change and run the tests that execute the changed lines."""
    lines, took = copy.measure_lines(room)
    if copy.run_pytest([str(list_test_files(room)[0].relative_to(REPOSITORY))], 10 * LEAST_S):
        sys.exit((copy.folder / "pytest.log").read_text() + "no test passes after a fork")
    for mutant in mutants:
        tests = select_tests(mutant, lines, took, copy.folder)
        limit_s = max(LEAST_S, 10 * sum(took[test] for test in tests))
        yield _report(mutant, tests, not tests or copy.survives(mutant, tests, limit_s))


def try_named(copy: Copy, rooms: tuple[str, ...]) -> Iterator[Row]:
    """Make each change of ``mutants.toml`` and run the tests that are named there."""
    changes, gone = load_named_mutants(rooms)
    for line in gone:
        print(line, flush=True)
    limits_s = {}
    for tests in sorted({tests for _, tests in changes}):
        began = time.monotonic()
        if copy.run_pytest(list(tests), 10 * LEAST_S):
            sys.exit((copy.folder / "pytest.log").read_text() + f"{tests} fail as they are")
        limits_s[tests] = max(LEAST_S, 10 * (time.monotonic() - began))
    for mutant, tests in changes:
        yield _report(mutant, tests, copy.survives(mutant, list(tests), limits_s[tests]))


def _report(mutant: Mutant, tests: Sequence[str], survived: bool) -> Row:
    """Print a change that no test detected; return the row for the output file."""
    if survived:
        print(f"{mutant.path}:{mutant.line}: {mutant.kind}, {len(tests)} tests run it")
        print(f"  - {' '.join(mutant.before.split())}\n  + {mutant.after}", flush=True)
    room = find_room(mutant.path) or "top"
    return {"room": room, "survived": survived, "tests": list(tests), **asdict(mutant)}


def _try_changes(given: argparse.Namespace, copy: Copy) -> Iterator[Row]:
    """Make each change that the arguments ask for and run its tests."""
    if given.named:
        yield from try_named(copy, tuple(given.rooms))
        return
    alive = None
    if given.again:
        kept = json.loads(given.again.read_text())["mutants"]
        alive = {(m["path"], m["before"], m["after"]) for m in kept if m["survived"]}
    for room in given.rooms or ROOMS:
        chosen = draw_mutants(room, given.count, given.seed, tuple(given.without))
        if alive is not None:
            chosen = [m for m in chosen if (m.path, m.before, m.after) in alive]
        yield from (try_without_coverage if given.quick else try_with_coverage)(copy, room, chosen)


def main() -> None:
    """Parse the arguments, try the changes and print the share that was detected."""
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
        for row in _try_changes(given, Copy(Path(folder).resolve())):
            rows.append(row)
            if given.out:  # after each change, so that an interrupted run keeps its results
                kept = {"seed": given.seed, "mutants": rows}
                given.out.write_text(json.dumps(kept, indent=1))
    for room in dict.fromkeys(row["room"] for row in rows):
        count = Counter(row["survived"] for row in rows if row["room"] == room)
        share = count[False] / max(count.total(), 1)
        print(f"{room}: {count[False]} of {count.total()} noticed, {share:.0%}")


if __name__ == "__main__":
    main()
