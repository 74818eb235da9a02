"""Static checks: one module turns names from files into paths, and one parses documents.

A path may be joined with a literal. Any other name is checked by `dmrl.guards.safe_names`, or is
listed below with the reason why it needs no check. Untrusted documents are parsed only in
`dmrl.guards.bounded_parsing`, which limits their size and depth.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import dmrl

SOURCE = Path(dmrl.__file__).resolve().parent
CHECKED = {
    "safe_join",
    "check_file_name",
    "check_split_name",
    "to_topic_file_name",
    "c_name",
    "shard_path",
}
"""Functions that return a safe file name, or a path made of safe names."""
METHODS = {"resolve", "absolute", "expanduser", "with_name", "with_suffix", "relative_to"}
CHECKED_BEFORE = "checked just before"
OURS = "made of literals and numbers of dmrl"
LISTED = "the name of an existing file in that folder"
GIVEN = "a path given by the user, with a suffix of dmrl"
BY_ROWS = "checked, or made of letters and digits, by ExportRows"
READ = "only read, in the folder of the source"
REASONS = {
    "deploy/export_folder.py: decoded": OURS,
    "viewer/flag_page.py: name": OURS,
    "pipeline/recipe_run.py: out": CHECKED_BEFORE,
    "pipeline/runner.py: name": LISTED,
    "deploy/c/pilot_code.py: name": OURS,
    "rendering/robots/primitives.py: f'{name}.toml'": OURS,
    "api/stages.py: f'{stage}.mcap'": OURS,
    "guards/safe_names.py: check_file_name(name, what) + suffix": CHECKED_BEFORE,
    "datasets/layout.py: f'data-{number}.arrow'": OURS,
    "datasets/layout.py: f'{split}-{number}.parquet'": CHECKED_BEFORE,
    "datasets/layout.py: split": CHECKED_BEFORE,
    "datasets/manifest.py: f'{number:05d}'": OURS,
    "deploy/c/__init__.py: file": "named by c_name",
    "deploy/c/run/compiled.py: name": OURS,
    "deploy/c/run/measure.py: f'{name}.c'": "named by c_name",
    "deploy/c/run/measure.py: f'{name}.o'": "named by c_name",
    "deploy/c/run/compile_targets.py: f'{name}.c'": "named by c_name",
    "deploy/export_folder.py: name": OURS,
    "deploy/onnx/float_cache.py: f'{key}.onnx'": "a hash",
    "deploy/onnx/float_cache.py: name": OURS,
    "evaluation/evaluate_recordings.py: f'{stem}.json'": OURS,
    "evaluation/pipeline_summary.py: name": OURS,
    "exchange/ros2.py: path.name": LISTED,
    "exchange/csv_parquet.py: name": "a number, and one of two endings",
    "exchange/detection_sets.py: f'instances_{split}.json'": BY_ROWS,
    "exchange/detection_sets.py: f'{row.name}.png'": BY_ROWS,
    "exchange/detection_sets.py: f'{row.name}.txt'": BY_ROWS,
    "exchange/detection_sets.py: name": BY_ROWS,
    "exchange/detection_sets.py: row.split": BY_ROWS,
    "exchange/detection_sets.py: shard": BY_ROWS,
    "exchange/lerobot.py: FILE.format(**place)": OURS,
    "exchange/lerobot.py: FILE.format(chunk_index=0, file_index=0)": OURS,
    "formats/files/labelled_pictures.py: end": "only read, and without '..'",
    "formats/files/yolo.py: *parts[:k]": LISTED,
    "formats/files/yolo.py: *parts[k + 1:]": LISTED,
    "formats/files/yolo.py: n": OURS,
    "formats/files/yolo.py: name": OURS,
    "formats/files/yolo.py: place": "only read, and without '..'",
    "formats/aideck/chip_outputs.py: f'{name}{number}.ppm'": READ,
    "formats/files/flight_csv.py: log.robot": LISTED,
    "formats/ros/reader.py: f'{path.name}-wal'": LISTED,
    "formats/published/locanet.py: name": READ,
    "formats/aideck/nanocockpit.py: f'{stem}{suffix}'": READ,
    "formats/aideck/nanocockpit.py: folder": OURS,
    "learn/training/checkpoint.py: name": OURS,
    "learn/pretrained/__init__.py: model": LISTED,
    "atomic_output.py: file": "a file that dmrl has just written",
    "atomic_output.py: last": OURS,
    "atomic_output.py: path.name + PARTIAL_SUFFIX": GIVEN,
    "card/figures.py: name": OURS,
    "html_report/collect.py: name": LISTED,
    "html_report/report_sections.py: name": LISTED,
    "html_report/report_sections.py: file": OURS,
    "html_report/recipe_figures.py: name": "only read, and nothing outside the folder",
    "pipeline/batch.py: n": LISTED,
    "pipeline/batch.py: name": LISTED,
    "pipeline/build_cache.py: name": LISTED,
    "pipeline/plan.py: name": "only read, and checked by _source_fault",
    "pipeline/plan.py: name.removeprefix(DATA).lstrip('/')": "only read, and checked likewise",
    "pipeline/runner.py: one.step.out": "checked by _out_fault of the plan",
    "pipeline/runner.py: step.out": "checked by _out_fault of the plan",
    "plots/style.py: stem.name + suffix": GIVEN,
    "recording/copying/resume.py: kept.name + '.new'": GIVEN,
    "recording/copying/resume.py: out.name + '.kept'": GIVEN,
    "rendering/blender_environment.py: f'{target.name}.partial-{os.getpid()}'": GIVEN,
    "stages/card.py: card.name": OURS,
    "stages/find.py: name": "validated as part of the catalogue, and only printed",
    "stages/sketch.py: name": OURS,
    "storage/remote.py: *one.parts[len(self.parts):]": "a name in the same bucket",
    "storage/remote.py: hashlib.sha256(version.encode()).hexdigest()[:16]": OURS,
    "storage/upload.py: file": "a file that dmrl has just written",
}
PARSERS = ("json.load", "json.loads", "tomllib.load", "tomllib.loads", "np.load", "pickle.")
MAY_PARSE = {
    "deploy/export_folder.py": "output of json.dumps",
    "deploy/usage.py": "output of json.dumps",
    "terminal/help_pages.py": "a file of the package",
    "rendering/robots/primitives.py": "a file of the package",
    "rendering/robots/quadrotor.py": "a file of the package",
    "rendering/backgrounds/room_items.py": "a file of the package",
    "rendering/settings.py": "a file of the package",
    "learn/inference/metric_definitions.py": "a file of the package",
    "guards/bounded_parsing.py": "the module for untrusted documents",
    "rendering/blender/protocol.py": "messages between processes of dmrl",
    "pipeline/process_pool.py": "messages between processes of dmrl",
    "pipeline/job_worker.py": "messages between processes of dmrl",
    "learn/networks/hdf5_arrays.py": "messages between processes of dmrl",
    "recipe.py": "output of json.dumps",
    "recording/provenance_inputs.py": "output of json.dumps",
    "learn/training/checkpoint.py": "output of json.dumps",
}


@cache
def sources() -> dict[str, list[ast.AST]]:
    """Return the syntax nodes of every module, by the path of its file. Cached."""
    return {
        path.relative_to(SOURCE.parent).as_posix().removeprefix("dmrl/"): list(
            ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        )
        for path in sorted([*SOURCE.rglob("*.py"), *(SOURCE.parent / "viewer").rglob("*.py")])
    }


def _is_path_hint(hint: ast.expr | None) -> bool:
    """Return whether an annotation is ``Path`` or ``Path | ...``."""
    while isinstance(hint, ast.BinOp):
        hint = hint.left
    return isinstance(hint, ast.Name) and hint.id == "Path"


class Paths:
    """Fields and functions that hold or return a path, according to their annotations."""

    def __init__(self, everywhere: dict[str, list[ast.AST]]) -> None:
        self.fields, self.functions = {"parent"}, {"Path"}
        for nodes in everywhere.values():
            for node in nodes:
                if isinstance(node, ast.ClassDef):
                    self.fields |= {
                        part.target.id
                        for part in node.body
                        if isinstance(part, ast.AnnAssign)
                        and isinstance(part.target, ast.Name)
                        and _is_path_hint(part.annotation)
                    }
                elif isinstance(node, ast.FunctionDef) and _is_path_hint(node.returns):
                    self.functions.add(node.name)

    def iter_joined(self, nodes: list[ast.AST]) -> Iterator[ast.expr]:
        """Yield every expression of a module that is joined to a path."""
        names = self._find_path_variables(nodes)
        for node in nodes:
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
                if self._is_path(node.left, names):
                    yield node.right
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                if node.func.attr in ("joinpath", "with_name", "with_stem"):
                    yield from node.args
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Path":
                yield from node.args[1:]

    def _find_path_variables(self, nodes: list[ast.AST]) -> set[str]:
        """Return the names of arguments and variables of a module that hold a path."""
        found = {
            node.arg
            for node in nodes
            if isinstance(node, ast.arg) and _is_path_hint(node.annotation)
        }
        named = [node for node in nodes if isinstance(node, ast.Assign | ast.withitem)]
        for _ in range(3):  # for variables that are assigned from variables
            for node in named:
                if isinstance(node, ast.Assign) and self._is_path(node.value, found):
                    found |= {t.id for t in node.targets if isinstance(t, ast.Name)}
                elif isinstance(node, ast.withitem) and isinstance(node.optional_vars, ast.Name):
                    call = node.context_expr
                    made = isinstance(call, ast.Call) and ast.unparse(call.func).split(".")[-1]
                    if made in ("atomic_file", "atomic_folder", "replace_file"):
                        found.add(node.optional_vars.id)
        return found

    def _is_path(self, node: ast.expr, names: set[str]) -> bool:
        """Return whether an expression is a path; ``names`` are the variables that hold one."""
        match node:
            case ast.Name(id=name):
                return name in names
            case ast.Attribute(attr=field):
                return field in self.fields
            case ast.Call(func=ast.Name(id=name)):
                return name in self.functions
            case ast.Call(func=ast.Attribute(attr=name)):
                return name in self.functions | METHODS
            case ast.BinOp(left=left, op=ast.Div()):
                return self._is_path(left, names)
            case ast.IfExp(body=body):
                return self._is_path(body, names)
            case ast.BoolOp(values=values):
                return any(self._is_path(value, names) for value in values)
        return False


def _is_trusted(node: ast.expr) -> bool:
    """Return whether a string is made of literals, constants and checked names only."""
    match node:
        case ast.Constant():
            return True
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name.isupper()
        case ast.JoinedStr(values=values):
            return all(
                _is_trusted(v.value) if isinstance(v, ast.FormattedValue) else True for v in values
            )
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _is_trusted(left) and _is_trusted(right)
        case ast.Call(func=ast.Name(id=name)) | ast.Call(func=ast.Attribute(attr=name)):
            return name in CHECKED
        case ast.IfExp(body=body, orelse=other):
            return _is_trusted(body) and _is_trusted(other)
    return False


def find_untrusted_joins() -> set[str]:
    """Return ``file: expression`` for every expression joined to a path that is not trusted."""
    paths = Paths(sources())
    return {
        f"{name}: {ast.unparse(part)}"
        for name, nodes in sources().items()
        for part in paths.iter_joined(nodes)
        if not _is_trusted(part)
    }


@pytest.mark.heavy
def test_a_path_is_joined_with_checked_names_alone() -> None:
    found = find_untrusted_joins()
    assert found - REASONS.keys() == set(), (
        "use dmrl.guards.safe_names, or add the reason to REASONS"
    )
    assert REASONS.keys() - found == set(), "REASONS lists expressions that no longer exist"


@pytest.mark.heavy
def test_untrusted_documents_are_parsed_in_one_module() -> None:
    found = {
        name
        for name, nodes in sources().items()
        for node in nodes
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(PARSERS)
    }
    assert found - MAY_PARSE.keys() == set()
    assert MAY_PARSE.keys() - found == set()
