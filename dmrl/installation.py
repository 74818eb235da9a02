"""Packages, programs and devices that dmrl can use, and how to get those that are missing.

It reads and installs nothing.
"""

import os
import platform
import shutil
import sys
from collections.abc import Iterator
from ctypes.util import find_library
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from packaging.requirements import Requirement

from dmrl.deploy.c.run import toolchain
from dmrl.errors import ToolError
from dmrl.rendering import blender_environment

EXTRAS = {
    "train": "dmrl train, predict",
    "label": "dmrl label, track",
    "calibrate": "dmrl calibrate",
    "keras": "published .h5 weights",
    "view": "dmrl view; its API moves every release",
    "plot": "figures of evaluations, reports",
    "bayer": "raw pictures of the AI-deck",
    "ros": "ROS bags, in and out",
    "yolo": "data.yaml of YOLO sets",
    "coco": "dmrl evaluate --robot-width-m",
    "table": "dmrl convert --to csv",
    "record": "dmrl record; cflib: GPL-3.0",
    "deploy": "ONNX: dmrl export, predict",
    "cluster": "dmrl --on ray",
    "storage": "s3://bucket/..., in and out",
    "index": "dmrl find, dataset --from-index",
}
"""Commands and features that need each extra of pyproject.toml."""
DRIVERS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
BLENDER_LIBRARIES = ("GL", "SM", "Xfixes", "Xi", "xkbcommon", "Xxf86vm")


@dataclass(frozen=True, slots=True)
class Part:
    """A package, program or device that dmrl can use.

    Parameters
    ----------
    name
        Name of the package, program or device.
    there
        Whether it is installed.
    found
        Version, path or number that was found.
    serves
        Commands and features that use it.
    remedy
        Line to type if it is missing.
    needed
        Whether dmrl needs it.
    """

    name: str
    there: bool
    found: str
    serves: str
    remedy: str = ""
    needed: bool = False


def list_parts() -> list[Part]:
    """Return everything that dmrl can use, and whether it is installed."""
    return [
        *_find_machine(),
        *_find_packages(),
        *_find_programs(),
        _find_vulkan(),
        _find_blender(),
        _find_gpu(),
    ]


def _find_machine() -> Iterator[Part]:
    python = platform.python_version()
    good = sys.version_info >= (3, 11)
    remedy = "" if good else "install Python 3.11 or newer"
    yield Part("Python", good, python, "everything", remedy, needed=True)
    yield Part("cores", True, str(os.cpu_count() or 1), "workers of dmrl render, run, train")
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    yield Part("free disk here", True, f"{free_gb:.0f} GB", "outputs")


def _find_packages() -> Iterator[Part]:
    """Yield the packages of the base, and those of every extra."""
    yield _check_group("base packages", "", "everything", "pip install dmrl", needed=True)
    for extra, serves in EXTRAS.items():
        yield _check_group(f"dmrl[{extra}]", extra, serves, f"pip install 'dmrl[{extra}]'")


def _check_group(name: str, extra: str, serves: str, remedy: str, *, needed: bool = False) -> Part:
    """Check packages that come together: all are installed, in versions that dmrl takes."""
    present, lacking = [], []
    for wanted in map(Requirement, requires("dmrl") or ()):
        mine = wanted.marker is None or "extra" not in str(wanted.marker)
        if wanted.name == "dmrl" or mine == bool(extra):
            continue  # an extra that takes in another one, or what the others have
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": extra}):
            continue
        found = _find_installed_version(wanted.name)
        present.append(f"{wanted.name} {found}")
        if not found:
            lacking.append(f"no {wanted.name}")
        elif not wanted.specifier.contains(found, prereleases=True):
            lacking.append(f"{wanted.name} {found}, not {wanted.specifier}")
    shown = ", ".join(lacking or present)
    return Part(name, not lacking, shown, serves, remedy if lacking else "", needed)


def _find_installed_version(package: str) -> str:
    """Return the version of an installed package; empty: there is none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _find_programs() -> Iterator[Part]:
    try:
        compiler = toolchain.find_host_compiler()
        yield Part("C compiler", True, compiler, "dmrl verify, predict --backend c")
    except ToolError:
        remedy = "apt-get install gcc"
        yield Part("C compiler", False, "", "dmrl verify, predict --backend c", remedy)
    for name in (toolchain.RISCV, toolchain.EMULATOR):
        path = shutil.which(name) or ""
        remedy = "" if path else f"apt-get install {toolchain.DEBIAN_PACKAGES[name]}"
        yield Part(name, bool(path), path, "dmrl verify: proof on RISC-V", remedy)


def _find_vulkan() -> Part:
    """Find a driver that rerun can draw with; macOS and Windows have their own."""
    serves = "dmrl view --screenshot"
    if platform.system() != "Linux":
        return Part("graphics driver", True, "of the system", serves)
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES") or ""
    files = [file for file in named.split(os.pathsep) if file and Path(file).is_file()]
    files += [str(file) for place in DRIVERS for file in sorted(Path(place).glob("*.json"))]
    there = bool(files) and find_library("vulkan") is not None
    found = f"{len(files)} drivers" if there else ""
    remedy = "" if there else "apt-get install mesa-vulkan-drivers"
    return Part("Vulkan driver", there, found, serves, remedy)


def _find_blender() -> Part:
    serves = "dmrl render, fly --camera-renderer blender"
    python = blender_environment.find_python()
    lacking = [name for name in BLENDER_LIBRARIES if find_library(name) is None]
    if platform.system() == "Linux" and lacking:
        remedy = f"apt-get install {blender_environment.SYSTEM_LIBRARIES}"
        return Part("Blender", False, f"no lib{lacking[0]}", serves, remedy)
    if python is None:
        return Part("Blender", False, "", serves, "dmrl render --setup")
    return Part(
        "Blender",
        True,
        f"{blender_environment.BLENDER} in {blender_environment.environment_folder()}",
        serves,
    )


def _find_gpu() -> Part:
    serves = "dmrl train, faster; all works without"
    if shutil.which("nvidia-smi") is None:
        return Part("NVIDIA GPU", False, "", serves)
    try:
        asked = ("nvidia-smi", "--query-gpu=name", "--format=csv,noheader")
        names = toolchain.run_program(asked, "the GPU's name").decode(errors="replace").split("\n")
    except ToolError as e:
        return Part("NVIDIA GPU", False, str(e), serves)
    return Part("NVIDIA GPU", bool(names[0]), ", ".join(filter(None, names)), serves)
