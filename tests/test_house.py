"""Rules for every source file: a docstring, and limited lengths of files and functions."""

import ast
import importlib.util
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

pytestmark = pytest.mark.heavy

ROOT = Path(__file__).parents[1]
PACKAGES = ("dmrl", "viewer", "schemas", "recipes")
MODULES = sorted(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))
LINES = 350
"""Largest number of lines of a file."""
FUNCTION_LINES = 25
"""Largest number of lines of nine functions in ten, without their docstrings."""


@cache
def parse(path: Path) -> ast.Module:
    """Return the syntax tree of a file. Cached."""
    return ast.parse(path.read_text(encoding="utf-8"))


def to_name(path: Path) -> str:
    """Return a path relative to the repository."""
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", MODULES, ids=to_name)
def test_modules_have_a_docstring_and_limited_length(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    said = ast.get_docstring(parse(path)) or ""
    assert len(said.split()) >= 3
    assert len(text.splitlines()) <= LINES


def test_files_beside_the_package_are_short_too() -> None:
    beside = [
        path for name in ("tests", "benchmarks", "docs") for path in (ROOT / name).rglob("*.py")
    ]
    lines = {to_name(path): len(path.read_text(encoding="utf-8").splitlines()) for path in beside}
    assert len(lines) > 300
    assert {name: count for name, count in lines.items() if count > LINES} == {}


def has_name(module: ModuleType, name: str) -> bool:
    """Return whether a module has an attribute or a submodule of this name."""
    if hasattr(module, name):
        return True
    is_package = hasattr(module, "__path__")
    return is_package and importlib.util.find_spec(f"{module.__name__}.{name}") is not None


def test_benchmarks_and_examples_import_names_that_exist() -> None:
    """No other test runs most benchmarks and examples, so a renamed function would go unnoticed."""
    missing = [
        f"{to_name(path)}: {node.module}.{one.name}"
        for folder in ("benchmarks", "examples")
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(parse(path))
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "dmrl"
        for one in node.names
        if not has_name(importlib.import_module(node.module or ""), one.name)
    ]
    assert missing == []


def count_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the number of lines of a function, without its decorators and its docstring."""
    first, last = function.body[0], function.end_lineno or function.lineno
    said = ast.get_docstring(function) is not None
    own = (first.end_lineno or first.lineno) - first.lineno + 1 if said else 0
    return last - function.lineno + 1 - own


def test_nine_functions_in_ten_are_short() -> None:
    found = sorted(
        (count_lines(node), to_name(path), node.name)
        for path in MODULES
        for node in ast.walk(parse(path))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    )
    assert len(found) > 1000
    assert found[len(found) * 9 // 10][0] <= FUNCTION_LINES, found[-20:]
