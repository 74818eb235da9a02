"""Small wrong changes to source code, and their random selection."""

import ast
import random
import re
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
NAMED = Path(__file__).with_name("mutants.toml")
"""Hand-written changes: mistakes that a newcomer might make."""

OTHER: dict[type, tuple[type, ...]] = {
    **{ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.GtE)},
    **{ast.Gt: (ast.GtE, ast.Lt), ast.GtE: (ast.Gt, ast.LtE)},
    **{ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,)},
    **{ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.Add: (ast.Sub,), ast.Sub: (ast.Add,)},
    **{ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.FloorDiv: (ast.Mult,)},
    **{ast.Mod: (ast.FloorDiv,), ast.Pow: (ast.Mult,), ast.BitAnd: (ast.BitOr,)},
    **{ast.BitOr: (ast.BitAnd,), ast.LShift: (ast.RShift,), ast.RShift: (ast.LShift,)},
}
"""The operators that replace an operator."""
IN_ANY_ORDER = ("min", "max", "minimum", "maximum", "hypot", "logical_and", "logical_or", "equal")
"""Functions whose result does not depend on the order of their arguments."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """A change that replaces ``before``, bytes ``start`` to ``end`` of a file, by ``after``."""

    path: str
    line: int
    kind: str
    start: int
    end: int
    before: str
    after: str


def iter_changes(tree: ast.AST) -> Iterator[tuple[str, ast.expr | ast.stmt, ast.AST]]:
    """Yield the kind of each change, the node that is changed, and its replacement."""
    for node in _iter_mutable(tree):
        if isinstance(node, ast.Compare):
            for k, operator in enumerate(node.ops):
                for other in OTHER[type(operator)]:
                    changed = deepcopy(node)
                    changed.ops[k] = other()
                    yield "comparison", node, changed
        elif isinstance(node, ast.BinOp) and not _is_text(node):
            yield from _change_arithmetic(node)
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
            yield from _swap_neighbours(node)


def _change_arithmetic(node: ast.BinOp) -> Iterator[tuple[str, ast.expr, ast.AST]]:
    """Yield an operation with another operator, without one term, and with the other sign."""
    for other in OTHER.get(type(node.op), ()):
        yield "arithmetic", node, ast.BinOp(node.left, other(), node.right)
    if isinstance(node.op, ast.Add | ast.Sub):
        yield "term", node, node.left
        yield "term", node, node.right
    if isinstance(node.op, ast.Mult | ast.Div | ast.MatMult):
        yield "sign", node, ast.UnaryOp(ast.USub(), node)


def _swap_neighbours(node: ast.AST) -> Iterator[tuple[str, ast.expr, ast.AST]]:
    """Yield a call, a tuple or a list with two neighbouring values swapped."""
    if isinstance(node, ast.Call):
        if getattr(node.func, "id", getattr(node.func, "attr", "")) in IN_ANY_ORDER:
            return
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
    """Return whether an operand is literally text, a list or a tuple."""
    kinds = (ast.JoinedStr, ast.List, ast.Tuple)
    return any(
        isinstance(n, kinds) or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in (node.left, node.right)
    )


def _iter_mutable(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that compute something: no annotations, f-strings or raised errors."""
    if isinstance(node, ast.JoinedStr | ast.Raise):
        return
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return  # zip(strict=True) only asserts equal lengths, so no test can fail without it
    yield node
    for name, value in ast.iter_fields(node):
        if isinstance(node, ast.Call) and _is_reshape_length(node, name):
            continue
        if name in ("annotation", "returns", "decorator_list", "pattern"):
            continue
        if name == "type" and isinstance(node, ast.ExceptHandler):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _iter_mutable(child)


def _is_reshape_length(node: ast.Call, field: str) -> bool:
    """Return whether a field holds the lengths of a reshape.

    NumPy infers any negative length, so that changing -1 to -2 has no effect.
    """
    return field == "args" and isinstance(node.func, ast.Attribute) and node.func.attr == "reshape"


def list_mutants(path: Path) -> list[Mutant]:
    """Return every change of a file."""
    source = path.read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for kind, node, changed in iter_changes(ast.parse(source)):
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


def draw_mutants(room: str, count: int, seed: int, without: tuple[str, ...]) -> list[Mutant]:
    """Return ``count`` random changes of a package's code, each kind equally often."""
    rng = random.Random(f"{room} {seed}")
    by_kind: dict[str, list[Mutant]] = defaultdict(list)
    for path in sorted((REPOSITORY / "dmrl" / room).rglob("*.py")):
        if path.stem not in without:
            for mutant in list_mutants(path):
                by_kind[mutant.kind].append(mutant)
    for mutants in by_kind.values():
        rng.shuffle(mutants)
    chosen: list[Mutant] = []
    while len(chosen) < count and any(by_kind.values()):
        chosen += [by_kind[kind].pop() for kind in sorted(by_kind) if by_kind[kind]]
    return chosen[:count]


def load_named_mutants(
    rooms: tuple[str, ...] = (),
) -> tuple[list[tuple[Mutant, tuple[str, ...]]], list[str]]:
    """Return the hand-written changes with their tests, and one line per inapplicable change.

    A change is inapplicable if its text occurs in its file never or more than once. Without
    ``rooms``, the changes of all packages are returned.
    """
    found, gone = [], []
    for where, changes in tomllib.loads(NAMED.read_text()).items():
        room = find_room(where)
        mirror = Path("tests", *Path(where).parts[1:-1], f"test_{Path(where).stem}.py")
        tests = changes.pop("tests", [str(mirror)])
        file = REPOSITORY / where
        source = file.read_bytes() if file.exists() else b""
        for what, (before, after) in changes.items() if room in rooms or not rooms else ():
            if source.count(before.encode()) != 1:
                gone.append(f"{where}: {what}: there is no {before!r}, or more than one")
                continue
            start = source.index(before.encode())
            end, line = start + len(before.encode()), source[:start].count(b"\n") + 1
            found.append((Mutant(where, line, what, start, end, before, after), tuple(tests)))
    return found, gone


def list_test_files(room: str) -> list[Path]:
    """Return the test files of a package."""
    return sorted((REPOSITORY / "tests" / room).rglob("test_*.py"))


def find_tests(mutant: Mutant) -> list[str]:
    """Return test files that may detect a change, without measuring which tests execute it.

    The module's own test file comes first, then those that name the module, small files first. For
    a module that no test file names, all test files of the package are returned.
    """
    path = Path(mutant.path)
    module = re.escape(".".join(path.with_suffix("").parts))
    names = re.compile(rf"\b({module}|{path.stem})\b")
    files = sorted(list_test_files(find_room(mutant.path)), key=lambda file: file.stat().st_size)
    own = [file for file in files if file.stem == f"test_{path.stem}"]
    others = [file for file in files if file not in own and names.search(file.read_text())]
    return [str(file.relative_to(REPOSITORY)) for file in (own + others) or files]


def find_room(path: str) -> str:
    """Return the folder of `dmrl/` that holds a file; empty for a file directly in `dmrl/`."""
    return path.split("/")[1] if path.count("/") > 1 else ""
