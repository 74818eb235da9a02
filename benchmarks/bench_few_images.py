"""Train on 10, 25, 50 and 2,000 labelled images of a new robot and a new lens; compare recall.

    python benchmarks/bench_few_images.py FOLDER [--seeds 3] [--init dmrl-nano]

The robot is a grey hexacopter, 0.35 m wide. The lens has a focal length of 230 px and barrel
distortion. The places are Blender's panoramas. Three of them are the user's: the training images
show these three, or only the first. Every network is evaluated in the same three places, with other
viewing directions, poses and light, and in the remaining panoramas. FOLDER keeps all recordings,
datasets and models; a later run reuses them.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import dmrl
from dmrl.geometry.camera_file import format_camera
from dmrl.geometry.frames import Camera
from dmrl.rendering.blender_environment import ensure_environment
from dmrl.rendering.renderer import list_shipped_panoramas
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_table

CAMERA = Camera(320, 224, 230.0, 230.0, 157.0, 115.0, (-0.18, 0.03, 0.0, 0.0, 0.0))
PLACES, JUDGED = ("courtyard", "interior", "city"), 300
SETS = (("10", 3, 10), ("25", 3, 25), ("50", 3, 50), ("50 of one place", 1, 50), ("2000", 3, 2000))
"""Title, number of places and number of images of each training set."""


def write_boxes(path: Path) -> None:
    """Write the hexacopter as an OBJ of boxes: a body, six arms and six rotors; metres, z up."""
    parts = [((0.0, 0.0, 0.0), (0.10, 0.08, 0.05), 0.0)]
    for angle in np.arange(6) * np.pi / 3:
        x, y = np.cos(angle), np.sin(angle)
        parts.append(((0.07 * x, 0.07 * y, 0.01), (0.14, 0.012, 0.012), angle))
        parts.append(((0.14 * x, 0.14 * y, 0.03), (0.07, 0.07, 0.006), angle + 0.4))
    lines = []
    for number, (middle, size, angle) in enumerate(parts):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        for sx, sy, sz in np.ndindex(2, 2, 2):
            corner = (np.array([sx, sy, sz]) - 0.5) * size
            x, y = turn @ corner[:2] + middle[:2]
            lines.append(f"v {x:.5f} {y:.5f} {corner[2] + middle[2]:.5f}")
        faces = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
        lines += [
            "f " + " ".join(str(8 * number + int(corner)) for corner in face.split())
            for face in faces
        ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def link_panoramas(folder: Path) -> dict[str, Path]:
    """Link Blender's panoramas in three folders: the first place, all three, and the others."""
    every = {path.stem: path for path in list_shipped_panoramas(ensure_environment(say))}
    others = tuple(sorted(every.keys() - set(PLACES)))
    groups = {"place": PLACES[:1], "places": PLACES, "others": others}
    for name, some in groups.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        for stem in some:
            if not (link := folder / name / every[stem].name).exists():
                link.symlink_to(every[stem])
    return {name: folder / name for name in groups}


def render(out: Path, lights: Path, images: int, seed: int) -> Path:
    """Render the robot in the panoramas of a folder, unless the recording exists."""
    robot, camera = out.parent / "hexacopter.obj", out.parent / "camera.toml"
    write_boxes(robot)
    camera.write_text(format_camera(CAMERA), encoding="utf-8")
    if not out.exists():
        dmrl.render(
            "synthetic_first_look", out, preset="himax", robots_max=1, depth_m=(0.4, 3.0),
            test_share=0.0, model=robot, model_up="z", scale=1.0, camera=camera, distorted=True,
            lights=lights, images=images, seed=seed, masks=False, depths=False,
        )  # fmt: skip
    return out


def train(
    folder: Path, panoramas: dict[str, Path], init: str, seed: int
) -> Iterator[tuple[str, Path]]:
    """Train on each set, unless its model exists; yield titles and models."""
    for title, places, images in SETS:
        name = f"{images}-of-{places}-{seed}"
        own = render(
            folder / f"{name}.mcap",
            panoramas["places" if places > 1 else "place"],
            images,
            100 + seed,
        )
        if not (data := folder / f"{name}-data").exists():
            dmrl.make_dataset(own, data, labels="truth", split="none")
        if not (folder / name).exists():
            dmrl.train(data, folder / name, recipe="own_camera", init=init, seed=seed)
        yield title, folder / name


def judge(model: str | Path, recording: Path, seen: Path) -> float:
    """Return the share of robots that a network finds within 20 px."""
    if not seen.exists():
        dmrl.predict(model, recording, seen)
    return float(dmrl.evaluate(seen, draws=1)["overall"]["within_20_px"]["value"])


def main() -> None:
    """Render, train, and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--init", default="dmrl-nano")
    given = parser.parse_args()
    folder = given.folder
    panoramas = link_panoramas(folder)
    sets = {
        name: render(folder / f"judge-{name}.mcap", panoramas[name], JUDGED, 900)
        for name in ("places", "others")
    }
    found: dict[str, list[list[float]]] = {}
    for seed in range(given.seeds):
        models = [("none", given.init), *train(folder, panoramas, given.init, seed)]
        for title, model in models:
            name = Path(model).name
            shares = [
                judge(model, recording, folder / f"{name}-on-{where}.mcap")
                for where, recording in sets.items()
            ]
            found.setdefault(title, []).append(shares)
    rows = [
        [title, *(f"{100 * m:.0f} +- {100 * s:.0f} %" for m, s in zip(*spread, strict=True))]
        for title, shares in found.items()
        for spread in ((np.mean(shares, axis=0), np.std(shares, axis=0)),)
    ]
    headers = ["training images", "the same places", "other places"]
    title = f"robots found within 20 px, mean and standard deviation of {given.seeds} seeds"
    print_table(title, headers, rows)


if __name__ == "__main__":
    main()
