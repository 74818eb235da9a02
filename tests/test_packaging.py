"""Packaging: all packages listed, data files present, one top-level name."""

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from itertools import chain
from pathlib import Path

import pytest

import dmrl

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SETUPTOOLS = PROJECT["tool"]["setuptools"]
FOLDER_OF: dict[str, str] = SETUPTOOLS["package-dir"]
MAPPED = [package for package, folder in FOLDER_OF.items() if package.replace(".", "/") != folder]


def folder_of(package: str) -> str:
    """Return the folder of a package in the checkout."""
    return FOLDER_OF.get(package, package.replace(".", "/"))


def test_every_python_folder_is_listed_as_a_package() -> None:
    found = {
        str(path.parent.relative_to(ROOT))
        for room in set(FOLDER_OF.values())
        for path in (ROOT / room).rglob("*.py")
    }
    assert found == {folder_of(package) for package in SETUPTOOLS["packages"]}


@pytest.mark.parametrize("package", SETUPTOOLS["packages"])
def test_every_package_has_an_init(package: str) -> None:
    assert (ROOT / folder_of(package) / "__init__.py").is_file()


def test_the_version_is_the_project_s() -> None:
    assert dmrl.__version__ == PROJECT["project"]["version"]


def test_every_extra_is_in_the_extra_that_brings_all() -> None:
    extras = dict(PROJECT["project"]["optional-dependencies"])
    (everything,) = extras.pop("all")
    assert everything == f"dmrl[{','.join(extras)}]"


def test_constraints_pin_every_direct_dependency_within_its_bounds() -> None:
    packaging = pytest.importorskip("packaging.requirements")
    pinned = {
        _normalize_name(line.split("==")[0]): line.split("==")[1].split()[0]
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        if "==" in line
    }
    listed = [
        *PROJECT["project"]["dependencies"],
        *chain.from_iterable(PROJECT["project"]["optional-dependencies"].values()),
        *PROJECT["dependency-groups"]["examples"],
        *(one for one in PROJECT["dependency-groups"]["dev"] if isinstance(one, str)),
    ]
    for text in listed:
        wanted = packaging.Requirement(text)
        if wanted.name != "dmrl":
            assert wanted.specifier.contains(pinned[_normalize_name(wanted.name)]), text


def test_every_pin_has_the_hashes_of_its_files() -> None:
    """`pip install --require-hashes -r constraints.txt` needs a hash for every file."""
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8").replace("\\\n", " ")
    pins = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert len(pins) > 200
    assert [pin for pin in pins if not re.search(r"--hash=sha256:[0-9a-f]{64}\b", pin)] == []
    assert [pin for pin in pins if "==" not in pin] == []


def _normalize_name(package: str) -> str:
    """Return the name of a distribution in the normal form of PEP 503."""
    return re.sub(r"[-_.]+", "-", package).lower()


@pytest.fixture(scope="module")
def dist_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel and the sdist from a copy of the tracked files; return their folder."""
    source = tmp_path_factory.mktemp("source")
    out = tmp_path_factory.mktemp("dist")
    tracked = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=False,
    )
    if tracked.returncode != 0:
        pytest.skip("not a git checkout")
    for name in filter(None, tracked.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    backend = pytest.importorskip("setuptools.build_meta")
    for build in ("build_sdist", "build_wheel"):
        code = f"from {backend.__name__} import {build}; {build}({str(out)!r})"
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def wheel(dist_folder: Path) -> zipfile.ZipFile:
    """Return the opened wheel."""
    return zipfile.ZipFile(next(dist_folder.glob("*.whl")))


@pytest.mark.heavy
def test_a_wheel_brings_one_top_level_name(wheel: zipfile.ZipFile) -> None:
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"dmrl"}


@pytest.mark.heavy
def test_a_wheel_holds_every_module_and_data_file(wheel: zipfile.ZipFile) -> None:
    names = set(wheel.namelist())
    wanted = {"dmrl/py.typed", "dmrl/schemas/dmrl.binpb", "dmrl/recipes/demo_flight.mcap"}
    wanted |= {f"dmrl/{p.relative_to(ROOT)}" for p in ROOT.glob("schemas/dmrl/v1/*.proto")}
    wanted |= {f"dmrl/{p.relative_to(ROOT)}" for p in ROOT.glob("recipes/**/*.toml")}
    for package in SETUPTOOLS["packages"]:
        place = package.replace(".", "/")
        wanted |= {f"{place}/{p.name}" for p in (ROOT / folder_of(package)).glob("*.py")}
    assert wanted <= names
    assert not [name for name in names if any(p.startswith("test") for p in Path(name).parts)]


@pytest.mark.heavy
def test_a_wheel_holds_the_licence(wheel: zipfile.ZipFile) -> None:
    (licence,) = [name for name in wheel.namelist() if name.endswith("licenses/LICENSE")]
    assert b"Apache License" in wheel.read(licence)


@pytest.mark.heavy
def test_sdist_holds_the_files_of_a_build(dist_folder: Path) -> None:
    with tarfile.open(next(dist_folder.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {"pyproject.toml", "README.md", "LICENSE", "dmrl/py.typed", "schemas/dmrl.binpb"}
    wanted |= {str(p.relative_to(ROOT)) for p in ROOT.glob("schemas/dmrl/v1/*.proto")}
    wanted |= {str(p.relative_to(ROOT)) for p in ROOT.glob("recipes/**/*.toml")}
    wanted |= {"recipes/demo_flight.mcap"}
    wanted |= {f"{FOLDER_OF[package]}/__init__.py" for package in MAPPED}
    assert wanted <= names


@pytest.mark.slow
def test_the_constraints_install_with_their_hashes_alone(tmp_path: Path) -> None:
    """The constraints list every dependency, and the hash of every file that pip may choose."""
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True)
    words = ["install", "--dry-run", "--quiet", "--require-hashes", "-r", "constraints.txt"]
    pip = [str(tmp_path / "venv" / "bin" / "python"), "-m", "pip"]
    done = subprocess.run([*pip, *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
