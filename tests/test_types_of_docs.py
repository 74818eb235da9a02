"""Examples and programs on pages pass pyright in strict mode."""

import ast
import json
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
FRAGMENTS = {"rendering.md", "tracking.md"}
"""Pages whose code uses variables that it does not define."""
INCOMPLETE = {
    "formats.md": "datasets",
    "own_camera.md": "cv2",
    "own_network.md": "torch",
    "own_network.py": "torch",
    "flight_strip.py": "pandas",
}
"""Files that use a package whose own types are incomplete."""
PYRIGHT = shutil.which("pyright", path=str(Path(sys.executable).parent)) or shutil.which("pyright")


def read_programs() -> dict[str, str]:
    """Return the Python code of each page and example, by file name."""
    found = {path.name: path.read_text(encoding="utf-8") for path in ROOT.glob("examples/*.py")}
    for page in (ROOT / "README.md", *ROOT.glob("docs/*.md")):
        blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
        if blocks and page.name not in FRAGMENTS:
            found[page.name] = "\n".join(blocks)
    return found


def run_pyright(folder: Path) -> list[tuple[str, str]]:
    """Run pyright in strict mode in a folder; return file and message of each error."""
    setup = {"typeCheckingMode": "strict", "reportMissingTypeStubs": False}
    (folder / "pyrightconfig.json").write_text(json.dumps(setup), encoding="utf-8")
    line = [str(PYRIGHT), "--pythonpath", sys.executable, "--outputjson", "."]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
    try:
        output = json.loads(done.stdout[done.stdout.index("{") :])
    except ValueError:
        pytest.skip(f"pyright does not start here: {(done.stderr or done.stdout)[-300:]}")
    return [
        (Path(one["file"]).name, f"{one['range']['start']['line'] + 1}: {one['message']}")
        for one in output["generalDiagnostics"]
        if one["severity"] == "error"
    ]


def find_imports(code: str) -> set[str]:
    """Return the top-level packages that code imports, without the standard library."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(str(node.module))
    return {name.split(".")[0] for name in found} - sys.stdlib_module_names


@pytest.mark.heavy
def test_make_demo_installs_what_pages_and_examples_import() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    line = re.search(r"\.demo:.*\n\t.*'\.\[([a-z,]+)\]' --group (\w+)\n", makefile)
    assert line
    tables = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras = tables["project"]["optional-dependencies"]
    listed = [*tables["project"]["dependencies"], *tables["dependency-groups"][line[2]]]
    listed += [text for extra in line[1].split(",") for text in extras[extra]]
    installed = {Requirement(text).name for text in listed} | {"dmrl"}
    packages = packages_distributions()
    wanted = {name for code in read_programs().values() for name in find_imports(code)}
    assert {"gymnasium", "rosbags", "datasets", "torch", "cv2"} <= wanted
    lacking = [name for name in wanted - {"dmrl"} if not installed & set(packages[name])]
    assert lacking == []


@pytest.mark.heavy
@pytest.mark.skipif(PYRIGHT is None, reason="pyright is not installed: pip install pyright")
def test_pages_and_examples_have_no_fault_that_pyright_finds(tmp_path: Path) -> None:
    for name, code in read_programs().items():
        head = ""
        if name in INCOMPLETE:
            rules = ("MemberType", "VariableType", "ArgumentType")
            head = f"# pyright: {', '.join(f'reportUnknown{rule}=false' for rule in rules)}\n"
        stem = Path(name).stem + ("_page.py" if name.endswith(".md") else ".py")
        (tmp_path / stem).write_text(head + code, encoding="utf-8")
    wrong = "import dmrl\ndmrl.label('a.mcap', gate=0.3)\ndmrl.label('a.mcap', gate_m='x')\n"
    (tmp_path / "wrong.py").write_text(wrong, encoding="utf-8")
    found = run_pyright(tmp_path)
    told = [message for name, message in found if name == "wrong.py"]
    assert len(told) == 2 and '"gate"' in told[0] and '"gate_m"' in told[1]
    assert [one for one in found if one[0] != "wrong.py"] == []
