"""Draw the pictures of README.md and docs/ again: ``make pictures`` does.

``pictures.py NAME ...`` draws only these. Every picture carries the hash of its recipe: the
commands, the shipped recipes that they name, and the Python code that draws. A test compares the
hashes without drawing. Docstrings and comments of the code do not count.

Needs Blender (``dmrl render --setup``) and a Vulkan driver. The picture of a real flight needs
its log: ``pictures.py --data DIR``.
"""

import argparse
import ast
import hashlib
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

ROOT = Path(__file__).parents[1]
HASH_KEY = "dmrl.drawn-by"
FLIGHT = (
    "dmrl fly fly_rendered flight.mcap --seed 3",
    "dmrl label flight.mcap labelled.mcap --gate-m 0.5",
    "dmrl predict dmrl-nano labelled.mcap nano.mcap",
)
"""A rendered flight of two drones, its labels and the detections of the network that ships."""
VIEWER = (
    *("viewer/drawing/*.py", "viewer/content/*.py", "viewer/views/*.py"),
    *("viewer/layouts.py", "viewer/scene.py", "viewer/show.py"),
)
RENDERER = ("dmrl/rendering/blender/*.py", "dmrl/rendering/camera/*.py")
WIDTH_PX, GAP_PX = 1280, 8
IMAGE_PANEL_PX = (113, 36, 688, 438)
"""The image in the first panel of the image layout, in a screenshot of 1600 x 1000."""
NEAR_PX = (270, 130, 590, 354)
"""The drone in it at 14 s of the follower's flight."""
SPACE_PX = (170, 110, 650, 446)
"""Space in the flight layout."""


@dataclass(frozen=True)
class Picture:
    """A picture of the documentation.

    Parameters
    ----------
    commands
        Command lines. They write ``picture.png``, or the files that ``join`` reads.
    code
        Patterns of the source files that draw it.
    join
        Function that joins files of a folder to the picture.
    """

    commands: tuple[str, ...]
    code: tuple[str, ...]
    join: Callable[[Path], Image.Image] | None = None

    @property
    def needs_data(self) -> bool:
        """Whether it needs data that does not ship."""
        return any("{data}" in command for command in self.commands)


def join_front(folder: Path) -> Image.Image:
    """Join the strip of the README from four pictures of a follower's flight.

    Above: an image, and its detection from near. Below: the flight in space, and an image of it.
    """
    names = ("plain", "near", "space", "there")
    boxes = (None, NEAR_PX, SPACE_PX, IMAGE_PANEL_PX)
    wide_px = (WIDTH_PX - GAP_PX) // 2
    high_px = wide_px * 7 // 10
    whole = Image.new("RGBA", (WIDTH_PX, 2 * high_px + GAP_PX))
    for k, (name, box) in enumerate(zip(names, boxes, strict=True)):
        one = Image.open(folder / f"{name}.png").convert("RGB")
        one = one.resize((wide_px, high_px), Image.Resampling.LANCZOS, box)
        whole.paste(one, (k % 2 * (wide_px + GAP_PX), k // 2 * (high_px + GAP_PX)))
    return whole


PICTURES = {
    "docs/images/front.png": Picture(
        (
            "dmrl fly fly_follow follow.mcap --eye dmrl-nano --seed 3 --duration-s 16",
            "python -c 'import dmrl; from PIL import Image;"
            ' images = dmrl.open("follow.mcap").images("cf1");'
            ' Image.fromarray(images.nearest(14.0)).save("plain.png")\'',
            "dmrl view follow.mcap --layout image --screenshot near.png --time 14",
            "dmrl view follow.mcap --screenshot space.png --time 11",
            "dmrl view follow.mcap --layout image --screenshot there.png --time 3.3",
        ),
        VIEWER,
        join_front,
    ),
    "docs/images/view-image.png": Picture(
        (
            *FLIGHT,
            "dmrl view nano.mcap --layout image --robot cf1 --screenshot picture.png --time 18.9",
        ),
        VIEWER,
    ),
    "docs/images/view-flight.png": Picture(
        (*FLIGHT, "dmrl view nano.mcap --screenshot picture.png --time 18.4"), VIEWER
    ),
    "docs/images/view-compare.png": Picture(
        (
            *FLIGHT,
            "dmrl predict dmrl-nano-violet labelled.mcap violet.mcap",
            "dmrl view violet.mcap nano.mcap --layout compare --screenshot picture.png --time 18.4",
        ),
        VIEWER,
    ),
    "docs/images/view-dataset.png": Picture(
        (
            *FLIGHT,
            "dmrl dataset labelled.mcap set --labels truth",
            "dmrl view set nano.mcap --screenshot picture.png --rank 5",
        ),
        (*VIEWER, "viewer/browse.py"),
    ),
    "docs/rendering.png": Picture(
        (
            "dmrl render synthetic_large sheet.mcap --images 48",
            "python {root}/benchmarks/contact_sheet.py sheet.mcap picture.png",
        ),
        (*RENDERER, "benchmarks/contact_sheet.py"),
    ),
    "docs/images/growth.png": Picture(
        (
            "python {root}/benchmarks/bench_growth.py --seconds 10 --times 1 10 100"
            " --plot picture.png",
        ),
        ("benchmarks/bench_growth.py",),
    ),
    "docs/images/eckart00.png": Picture(
        (
            "dmrl convert {data}/eckart00_brushless_flights eckart00.mcap",
            "python {root}/benchmarks/state_and_capture.py eckart00.mcap picture.png",
        ),
        ("benchmarks/state_and_capture.py",),
    ),
}


def compute_hash(name: str) -> str:
    """Return the hash of all that determines a picture: commands, recipes and code."""
    picture = PICTURES[name]
    parts = list(picture.commands)
    words = {word for command in picture.commands for word in shlex.split(command)}
    parts += [
        path.read_text(encoding="utf-8")
        for path in sorted(ROOT.glob("recipes/*.toml"))
        if path.stem in words
    ]
    for pattern in picture.code:
        parts += [_read_code(path) for path in sorted(ROOT.glob(pattern))]
    if picture.join:
        parts.append(_read_code(Path(__file__), picture.join.__name__))
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def read_hash(path: Path) -> str | None:
    """Return the hash that a picture carries; None, if it carries none."""
    with Image.open(path) as image:
        return image.info.get(HASH_KEY)


def _read_code(path: Path, function: str | None = None) -> str:
    """Return the code of a file, or of one function, without docstrings and comments."""
    tree: ast.AST = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [one for one in body if not _is_text(one)]  # type: ignore[attr-defined]
    if function is not None:
        tree = next(n for n in ast.walk(tree) if getattr(n, "name", None) == function)
    return ast.dump(tree)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def draw(name: str, folder: Path, data: Path | None) -> None:
    """Run the commands of a picture in a folder, and write it with its hash.

    Commands that have run in this folder do not run again: pictures share their recordings.
    """
    picture = PICTURES[name]
    for old in folder.glob("*.png"):
        old.unlink()
    for command in picture.commands:
        done = folder / f".{hashlib.sha256(command.encode()).hexdigest()[:16]}"
        if done.exists() and ".png" not in command:
            continue
        words = shlex.split(command.replace("{root}", str(ROOT)).replace("{data}", str(data)))
        words = [str(Path(sys.executable).parent / words[0]), *words[1:]]
        subprocess.run(words, cwd=folder, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
        done.touch()
    image = picture.join(folder) if picture.join else Image.open(folder / "picture.png")
    info = PngInfo()
    info.add_text(HASH_KEY, compute_hash(name))
    image.save(ROOT / name, optimize=True, pnginfo=info)
    print(f"{name}: {(ROOT / name).stat().st_size // 1000} kB")


def main() -> None:
    """Draw the named pictures, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="pictures, such as docs/images/view-image.png")
    parser.add_argument("--data", type=Path, help="folder with eckart00_brushless_flights")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in asked.names or PICTURES:
            if PICTURES[name].needs_data and asked.data is None:
                print(f"{name}: left as it is. It needs data that does not ship: --data DIR")
                continue
            draw(name, Path(folder), asked.data)


if __name__ == "__main__":
    main()
