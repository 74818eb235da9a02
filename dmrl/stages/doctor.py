"""``dmrl doctor``: what is installed, what for, and the line to type for what is not.

It looks and installs nothing. A thing that is missing is no error, since no command needs all
of them; that the base does not work is one.
"""

import os
import platform
import shutil
import sys
from collections.abc import Iterator
from ctypes.util import find_library
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from packaging.requirements import Requirement

from dmrl.deploy.c.run import toolchain
from dmrl.errors import SettingError, ToolError
from dmrl.rendering import blender_environment
from dmrl.terminal.arguments import AsJson
from dmrl.terminal.tables import print_json, print_line, print_table

EXTRAS = {
    "train": "dmrl train, predict",
    "label": "dmrl label, track",
    "calibrate": "dmrl calibrate",
    "keras": "published .h5 weights",
    "view": "dmrl view; its API moves every release",
    "plot": "figures of cards and evaluations",
    "bayer": "raw pictures of the AI-deck",
    "ros": "ROS bags, in and out",
    "table": "dmrl convert --to csv",
    "record": "dmrl record; cflib: GPL-3.0",
    "deploy": "ONNX: dmrl export, predict",
    "cluster": "dmrl --on ray",
    "storage": "s3://bucket/..., in and out",
    "index": "dmrl find, dataset --from-index",
}
"""What each extra of pyproject.toml is for."""
DRIVERS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
BLENDER_LIBRARIES = ("GL", "SM", "Xfixes", "Xi", "xkbcommon", "Xxf86vm")


@dataclass(frozen=True, slots=True)
class Part:
    """Something that dmrl can use.

    Parameters
    ----------
    name
        Of the package, program or device.
    there
        Whether it is there.
    found
        What is there: a version, a path, a number.
    serves
        What it is for.
    way
        What to type where it is not there.
    needed
        Whether nothing works without it.
    """

    name: str
    there: bool
    found: str
    serves: str
    way: str = ""
    needed: bool = False


def parts() -> list[Part]:
    """Everything that dmrl can use, and whether it is there."""
    return [*_machine(), *_packages(), *_programs(), _vulkan(), _blender(), _gpu()]


def command(*, as_json: AsJson = False) -> None:
    """Say what is installed, what it is for, and how to get what is missing.

    Parameters
    ----------
    as_json
        Print one JSON document instead of the table.
    """
    found = parts()
    if as_json:
        print_json([asdict(part) for part in found])
    else:
        rows = [(part.name, part.found or "-", part.serves, part.way) for part in found]
        print_table("", ("what", "found", "for", "to get it"), rows)
    if lacking := [part for part in found if part.needed and not part.there]:
        raise SettingError(f"{lacking[0].name}: {lacking[0].found}. Try: {lacking[0].way}")
    if not as_json:
        print_line(_verdict(found))


def _verdict(found: list[Part]) -> str:
    missing = [part.name for part in found if not part.there]
    rest = f"Not there: {', '.join(missing)}" if missing else "Nothing is missing"
    return f"The base works. {rest}."


def _machine() -> Iterator[Part]:
    python = platform.python_version()
    good = sys.version_info >= (3, 11)
    way = "" if good else "install Python 3.11 or newer"
    yield Part("Python", good, python, "everything", way, needed=True)
    yield Part("cores", True, str(os.cpu_count() or 1), "workers of dmrl render, run, train")
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    yield Part("free disk here", True, f"{free_gb:.0f} GB", "outputs")


def _packages() -> Iterator[Part]:
    """The packages of the base, and those of every extra."""
    yield _group("base packages", "", "everything", "pip install dmrl", needed=True)
    for extra, serves in EXTRAS.items():
        yield _group(f"dmrl[{extra}]", extra, serves, f"pip install 'dmrl[{extra}]'")


def _group(name: str, extra: str, serves: str, way: str, *, needed: bool = False) -> Part:
    """Packages that come together: all there, in versions that dmrl takes, or which is not."""
    said, lacking = [], []
    for wanted in map(Requirement, requires("dmrl") or ()):
        mine = wanted.marker is None or "extra" not in str(wanted.marker)
        if wanted.name == "dmrl" or mine == bool(extra):
            continue  # an extra that takes in another one, or what the others have
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": extra}):
            continue
        found = _version(wanted.name)
        said.append(f"{wanted.name} {found}")
        if not found:
            lacking.append(f"no {wanted.name}")
        elif not wanted.specifier.contains(found, prereleases=True):
            lacking.append(f"{wanted.name} {found}, not {wanted.specifier}")
    shown = ", ".join(lacking or said)
    return Part(name, not lacking, shown, serves, way if lacking else "", needed)


def _version(package: str) -> str:
    """Of an installed package; empty: there is none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _programs() -> Iterator[Part]:
    try:
        compiler = toolchain.host_compiler()
        yield Part("C compiler", True, compiler, "dmrl verify, predict --backend c")
    except ToolError:
        way = "apt-get install gcc"
        yield Part("C compiler", False, "", "dmrl verify, predict --backend c", way)
    for name in (toolchain.RISCV, toolchain.EMULATOR):
        path = shutil.which(name) or ""
        way = "" if path else f"apt-get install {toolchain.PACKAGES[name]}"
        yield Part(name, bool(path), path, "dmrl verify: proof on RISC-V", way)


def _vulkan() -> Part:
    """A driver that rerun can draw with; macOS and Windows have their own."""
    serves = "dmrl view --screenshot"
    if platform.system() != "Linux":
        return Part("graphics driver", True, "of the system", serves)
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES") or ""
    files = [file for file in named.split(os.pathsep) if file and Path(file).is_file()]
    files += [str(file) for place in DRIVERS for file in sorted(Path(place).glob("*.json"))]
    there = bool(files) and find_library("vulkan") is not None
    found = f"{len(files)} drivers" if there else ""
    way = "" if there else "apt-get install mesa-vulkan-drivers"
    return Part("Vulkan driver", there, found, serves, way)


def _blender() -> Part:
    serves = "dmrl render, fly --camera-renderer blender"
    python = blender_environment.python()
    lacking = [name for name in BLENDER_LIBRARIES if find_library(name) is None]
    if platform.system() == "Linux" and lacking:
        way = f"apt-get install {blender_environment.LIBRARIES}"
        return Part("Blender", False, f"no lib{lacking[0]}", serves, way)
    if python is None:
        return Part("Blender", False, "", serves, "dmrl render --setup")
    return Part(
        "Blender", True, f"{blender_environment.BLENDER} in {blender_environment.folder()}", serves
    )


def _gpu() -> Part:
    serves = "dmrl train, faster; all works without"
    if shutil.which("nvidia-smi") is None:
        return Part("NVIDIA GPU", False, "", serves)
    try:
        asked = ("nvidia-smi", "--query-gpu=name", "--format=csv,noheader")
        names = toolchain.run(asked, "the GPU's name").decode(errors="replace").split("\n")
    except ToolError as e:
        return Part("NVIDIA GPU", False, str(e), serves)
    return Part("NVIDIA GPU", bool(names[0]), ", ".join(filter(None, names)), serves)
