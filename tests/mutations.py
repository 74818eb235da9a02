"""Small wrong changes to code: which there are, and which of them a seed draws."""

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
"""Changes that people made by hand: what an outsider would break."""

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
IN_ANY_ORDER = ("min", "max", "minimum", "maximum", "hypot", "logical_and", "logical_or", "equal")
"""Functions that give the same whichever argument comes first."""


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
        if isinstance(node, ast.Call) and _is_left_open(node, name):
            continue
        if name in ("annotation", "returns", "decorator_list", "pattern"):
            continue
        if name == "type" and isinstance(node, ast.ExceptHandler):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _code(child)


def _is_left_open(node: ast.Call, field: str) -> bool:
    """Whether these are the lengths of a reshape: any negative one is the one not given."""
    return field == "args" and isinstance(node.func, ast.Attribute) and node.func.attr == "reshape"


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


def named(rooms: tuple[str, ...] = ()) -> tuple[list[tuple[Mutant, tuple[str, ...]]], list[str]]:
    """The changes made by hand, each with the tests that should notice; of some rooms or all.

    And what can no longer be changed: it does not stand in its file, or stands there twice.
    """
    found, gone = [], []
    for where, changes in tomllib.loads(NAMED.read_text()).items():
        room = room_of(where)
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


def files_of(room: str) -> list[Path]:
    """The files of a room's tests."""
    return sorted((REPOSITORY / "tests" / room).rglob("test_*.py"))


def near(mutant: Mutant) -> list[str]:
    """Files of tests that may notice, where nobody measured which tests run a line.

    The module's own, then those that name it, small ones first; of a module that none names, all
    of the room. Fewer than those that run the line: what they let pass, another may notice.
    """
    path = Path(mutant.path)
    module = re.escape(".".join(path.with_suffix("").parts))
    names = re.compile(rf"\b({module}|{path.stem})\b")
    files = sorted(files_of(room_of(mutant.path)), key=lambda file: file.stat().st_size)
    own = [file for file in files if file.stem == f"test_{path.stem}"]
    others = [file for file in files if file not in own and names.search(file.read_text())]
    return [str(file.relative_to(REPOSITORY)) for file in (own + others) or files]


def room_of(path: str) -> str:
    """The folder of `dmrl/` that a file is in; empty for one at the top."""
    return path.split("/")[1] if path.count("/") > 1 else ""
