"""Small wrong changes to a room's code, and whether the tests of that room notice.

    make mutants ARGS="geometry labelling --count 30 --seed 1"

Draws changes by a seed, each kind as often as the others, makes one at a time in a copy of the
tree, and runs the room's tests until one fails: those of the module first, then the other files
that run the changed line. What no test noticed is printed; ``--out`` keeps all.
"""

import argparse
import ast
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path

from coverage import Coverage, CoverageData

REPOSITORY = Path(__file__).parents[1]
ROOMS = ("geometry", "estimation", "labelling", "learn", "recording", "formats", "deploy")
BESIDE = ("viewer", "schemas", "recipes")
"""Folders at the top that are imported as parts of dmrl."""
LEAST_S = 120.0
"""Tests that run for longer than this, and than ten times what they should, do not end."""

OTHER: dict[type, tuple[type, ...]] = {
    **{ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.GtE)},
    **{ast.Gt: (ast.GtE, ast.Lt), ast.GtE: (ast.Gt, ast.LtE)},
    **{ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,)},
    **{ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.Add: (ast.Sub,), ast.Sub: (ast.Add,)},
    **{ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.FloorDiv: (ast.Mult,)},
    **{ast.Mod: (ast.FloorDiv,), ast.Pow: (ast.Mult,), ast.BitAnd: (ast.BitOr,)},
    **{ast.BitOr: (ast.BitAnd,), ast.LShift: (ast.RShift,), ast.RShift: (ast.LShift,)},
}
"""What takes the place of an operator."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: ``before``, bytes ``start`` to ``end`` of a file, becomes ``after``."""

    path: str
    line: int
    kind: str
    start: int
    end: int
    before: str
    after: str


def changes(tree: ast.AST) -> Iterator[tuple[str, ast.expr | ast.stmt, ast.AST]]:
    """Kind of each change, what is changed, and what takes its place."""
    for node in _code(tree):
        if isinstance(node, ast.Compare):
            for k, operator in enumerate(node.ops):
                for other in OTHER[type(operator)]:
                    changed = deepcopy(node)
                    changed.ops[k] = other()
                    yield "comparison", node, changed
        elif isinstance(node, ast.BinOp) and not _is_text(node):
            yield from _of_arithmetic(node)
        elif isinstance(node, ast.BoolOp):
            for k in range(len(node.values)):
                rest = node.values[:k] + node.values[k + 1 :]
                yield "term", node, ast.BoolOp(node.op, rest) if rest[1:] else rest[0]
        elif isinstance(node, ast.AugAssign):
            yield "term", node, ast.Pass()
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield "sign", node, node.operand
        elif isinstance(node, ast.Constant):
            if isinstance(node.value, bool):
                yield "constant", node, ast.Constant(not node.value)
            elif isinstance(node.value, int):
                yield "constant", node, ast.Constant(node.value + 1)
            elif isinstance(node.value, float):
                yield "constant", node, ast.Constant(2 * node.value or 1.0)
        else:
            yield from _swapped(node)


def _of_arithmetic(node: ast.BinOp) -> Iterator[tuple[str, ast.expr, ast.AST]]:
    for other in OTHER.get(type(node.op), ()):
        yield "arithmetic", node, ast.BinOp(node.left, other(), node.right)
    if isinstance(node.op, ast.Add | ast.Sub):
        yield "term", node, node.left
        yield "term", node, node.right
    if isinstance(node.op, ast.Mult | ast.Div | ast.MatMult):
        yield "sign", node, ast.UnaryOp(ast.USub(), node)


def _swapped(node: ast.AST) -> Iterator[tuple[str, ast.expr, ast.AST]]:
    """Calls, and lists of values, with two neighbours swapped."""
    if isinstance(node, ast.Call):
        field = "args"
    elif isinstance(node, ast.Tuple | ast.List) and isinstance(node.ctx, ast.Load):
        field = "elts"
    else:
        return
    values = getattr(node, field)
    if any(isinstance(value, ast.Slice) for value in values):
        return
    for k in range(len(values) - 1):
        pair = values[k : k + 2]
        same = ast.dump(pair[0]) == ast.dump(pair[1])
        if same or any(isinstance(v, ast.Starred | ast.Constant | ast.JoinedStr) for v in pair):
            continue
        changed = deepcopy(node)
        getattr(changed, field)[k : k + 2] = reversed(deepcopy(pair))
        yield "swap", node, changed


def _is_text(node: ast.BinOp) -> bool:
    """Whether an operator joins text or lists, as far as one can see."""
    kinds = (ast.JoinedStr, ast.List, ast.Tuple)
    return any(
        isinstance(n, kinds) or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in (node.left, node.right)
    )


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """What is computed: no annotations, no text, no words of an error."""
    if isinstance(node, ast.JoinedStr | ast.Raise):
        return
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return  # of zip: says only that what is so is so
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "pattern"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _code(child)


def mutants_of(path: Path) -> list[Mutant]:
    """Every change of a file."""
    source = path.read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for kind, node, changed in changes(ast.parse(source)):
        assert node.end_lineno is not None and node.end_col_offset is not None
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        after = ast.unparse(ast.fix_missing_locations(deepcopy(changed)))
        if isinstance(changed, ast.expr) and not isinstance(changed, ast.Constant | ast.Tuple):
            after = f"({after})"
        before = source[start:end].decode()
        where = str(path.relative_to(REPOSITORY))
        found.append(Mutant(where, node.lineno, kind, start, end, before, after))
    return found


def drawn(room: str, count: int, seed: int, without: tuple[str, ...]) -> list[Mutant]:
    """Some changes of a room's code, each kind as often as the others."""
    rng = random.Random(f"{room} {seed}")
    by_kind: dict[str, list[Mutant]] = defaultdict(list)
    for path in sorted((REPOSITORY / "dmrl" / room).rglob("*.py")):
        if path.stem not in without:
            for mutant in mutants_of(path):
                by_kind[mutant.kind].append(mutant)
    for mutants in by_kind.values():
        rng.shuffle(mutants)
    chosen: list[Mutant] = []
    while len(chosen) < count and any(by_kind.values()):
        chosen += [by_kind[kind].pop() for kind in sorted(by_kind) if by_kind[kind]]
    return chosen[:count]


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
        path = os.pathsep.join([str(folder), str(folder / "tests")])
        self.env = {"DMRL_DATA": str(data), **os.environ, "OMP_NUM_THREADS": "1"}
        self.env |= {"PYTHONPATH": path, "TMPDIR": str(folder / "tmp")}
        (folder / "tmp").mkdir()

    def pytest(self, tests: list[str], *before: str, limit_s: float | None = None) -> int | None:
        """Exit status of pytest up to its first failure; None where it did not end."""
        command = [sys.executable, *before, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
        process = subprocess.Popen(
            [*command, *tests],
            cwd=self.folder,
            env=self.env,
            stdout=(self.folder / "pytest.log").open("w"),
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            return process.wait(limit_s)
        except subprocess.TimeoutExpired:
            return None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            shutil.rmtree(self.folder / "tmp", ignore_errors=True)
            (self.folder / "tmp").mkdir()

    def lines(self, room: str) -> CoverageData:
        """Which files of a room's tests run which lines of it. All of them pass."""
        data = self.folder / f"{room}.coverage"
        how = ["coverage", "run", f"--source={self.folder / 'dmrl' / room}", f"--data-file={data}"]
        if self.pytest([f"tests/{room}", "-p", "mutants"], "-m", *how):
            sys.exit((self.folder / "pytest.log").read_text() + f"tests/{room} fail as they are")
        found = CoverageData(str(data))
        found.read()
        return found

    def survives(self, mutant: Mutant, tests: list[str], limit_s: float) -> bool:
        """Whether the tests pass with a change."""
        path = self.folder / mutant.path
        source = path.read_bytes()
        path.write_bytes(source[: mutant.start] + mutant.after.encode() + source[mutant.end :])
        # Python takes a compiled file for that of another change if size and time are the same.
        os.utime(path, (mutant.start, mutant.start + len(mutant.after)))
        try:
            return self.pytest(tests, limit_s=limit_s) == 0
        finally:
            path.write_bytes(source)


def pytest_runtest_logstart(nodeid: str) -> None:
    """As a plug-in of pytest: lines that run from here on are of this test's file."""
    running = Coverage.current()
    if running is not None:
        running.switch_context(nodeid.partition("::")[0])


def tests_of(mutant: Mutant, room: str, lines: CoverageData, folder: Path) -> list[str]:
    """Files of tests that may notice: the module's own first."""
    measured = {Path(name).resolve(): name for name in lines.measured_files()}
    name = measured.get((folder / mutant.path).resolve())
    by_line = lines.contexts_by_lineno(name) if name else {}
    rows = range(mutant.line, mutant.line + mutant.before.count("\n") + 1)
    files = {file for row in rows for file in by_line.get(row, ())}
    if "" in files:  # runs when the module is imported
        files = {str(p.relative_to(REPOSITORY)) for p in _tests(room)}
    own = f"test_{Path(mutant.path).stem}.py"
    return sorted(files, key=lambda file: (Path(file).name != own, file))


def _tests(room: str) -> list[Path]:
    return sorted((REPOSITORY / "tests" / room).rglob("test_*.py"))


def measured(copy: Copy, room: str, mutants: list[Mutant]) -> list[dict[str, object]]:
    """Each change, and whether it was noticed; those that were not are printed."""
    began = time.monotonic()
    lines = copy.lines(room)
    limit_s = max(LEAST_S, 10 * (time.monotonic() - began))
    rows = []
    for mutant in mutants:
        tests = tests_of(mutant, room, lines, copy.folder)
        survived = not tests or copy.survives(mutant, tests, limit_s)
        rows.append({"room": room, "survived": survived, "tests": tests, **asdict(mutant)})
        if survived:
            print(f"{mutant.path}:{mutant.line}: {mutant.kind}, {len(tests)} files of tests run it")
            print(f"  - {' '.join(mutant.before.split())}\n  + {mutant.after}", flush=True)
    return rows


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("rooms", nargs="*", default=ROOMS, help=f"of {', '.join(ROOMS)}")
    parser.add_argument("--count", type=int, default=30, help="changes of each room")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without", action="append", default=[], help="a module to leave alone")
    parser.add_argument("--again", type=Path, help="only what survived by this file of --out")
    parser.add_argument("--out", type=Path, help="where to keep every change, as JSON")
    given = parser.parse_args()
    alive = None
    if given.again:
        kept = json.loads(given.again.read_text())["mutants"]
        alive = {(m["path"], m["before"], m["after"]) for m in kept if m["survived"]}
    rows = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = Copy(Path(folder).resolve())
        for room in given.rooms:
            chosen = drawn(room, given.count, given.seed, tuple(given.without))
            if alive is not None:
                chosen = [m for m in chosen if (m.path, m.before, m.after) in alive]
            rows += measured(copy, room, chosen)
            if given.out:
                given.out.write_text(json.dumps({"seed": given.seed, "mutants": rows}, indent=1))
    for room in given.rooms:
        count = Counter(row["survived"] for row in rows if row["room"] == room)
        share = count[False] / max(count.total(), 1)
        print(f"{room}: {count[False]} of {count.total()} noticed, {share:.0%}")


if __name__ == "__main__":
    main()
