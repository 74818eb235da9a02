"""Figures of dmrl render: reprojection, grain, cost against the published way, memory.

    python benchmarks/bench_render.py reprojection [--images 500]
    python benchmarks/bench_render.py grain --images 24 --backgrounds DIR
    python benchmarks/bench_render.py speed --model crazyflie-published.blend --backgrounds DIR
    python benchmarks/bench_render.py memory [--images 3000]

CPU seconds are those of all processes together, start-up included where not said otherwise.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from dmrl.geometry.frames import Array, Camera, project
from dmrl.rendering import crazyflie
from dmrl.rendering.backdrops import photos_in
from dmrl.rendering.environment import ensure
from dmrl.rendering.lens import Picture, image_from_pinhole
from dmrl.rendering.randomise import World, draw_scene
from dmrl.rendering.renderer import Model, Renderer
from dmrl.rendering.sensor import Sensor
from dmrl.rendering.shot import Shot
from dmrl.rendering.sketch import Pose
from dmrl.stages.render import camera_of, run, settings_of
from dmrl.terminal.progress import say

PUBLISHED_WAY = Path(__file__).parent / "published_way.py"
SAMPLES, FEW = 16, 4
MANY_SAMPLES = 512
MM_PER_UNIT = 0.002  # the published model, at twice life size as the authors rendered it


def mesh_box(camera: Camera, pose: Pose, points: Array) -> Array:
    """Left, top, right, bottom of a mesh's corners in the image, clipped to it.

    Parameters
    ----------
    camera
        Takes the image.
    pose
        Of the robot.
    points
        (N, 3) corners, body frame.
    """
    xyz = points @ pose.camera_from_body.T + pose.xyz_camera
    uv, _ = project(xyz[xyz[:, 0] > 0.01], camera.image_from_optical)
    uv = image_from_pinhole(uv, camera)
    box = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
    return np.clip(box, 0, (camera.width_px, camera.height_px) * 2)


def reprojection(recipe: str, images: int) -> dict[str, float]:
    """Distance of alpha boxes' edges from the mesh's, pixels, robots that nothing hides.

    Parameters
    ----------
    recipe
        Preset to draw from.
    images
        How many.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recipe.toml"
        path.write_text(f'kind = "render"\npreset = "{recipe}"\nempty_share = 0.0\n')
        settings = settings_of(str(path), images=images)
    camera = camera_of(settings)
    model = Model(settings.model, settings.scale, settings.model_up)
    errors, middles = [], []
    with Renderer(ensure(say), model) as renderer:
        world = World(
            settings, camera, renderer.radius_m, tuple(renderer.lights), renderer.panorama, None
        )
        world = replace(world, panorama=_grey)
        scenes = [draw_scene(world, k) for k in range(images)]
        shots = renderer.shots((camera, scene.robots, scene.look) for scene in scenes)
        for scene, shot in zip(scenes, shots, strict=True):
            for k, robot in enumerate(scene.robots):
                if shot.visible_share[k] < 1 or np.isnan(shot.box_px[k]).any():
                    continue
                turn = (robot.paint["rotor_first_rad"], robot.paint["rotor_sweep_rad"])
                points = crazyflie.outline(settings.scale, *turn)
                box = mesh_box(camera, robot.pose, points)
                errors.append(shot.box_px[k] - box)
                middles.append((shot.box_px[k] - box).reshape(2, 2).mean(axis=0))
    edges = np.array(errors)
    return {
        "robots": len(edges),
        "median_px": float(np.median(np.abs(edges))),
        "p95_px": float(np.percentile(np.abs(edges), 95)),
        **{
            f"median_{name}_px": float(value)
            for name, value in zip(
                ("left", "top", "right", "bottom"), np.median(edges, axis=0), strict=True
            )
        },
        "median_middle_px": float(np.median(np.abs(middles))),
    }


def grain(recipe: str, images: int, backgrounds: Path) -> dict[str, float]:
    """What light paths leave of noise on robots, and the sensor's own, grey levels of 256.

    Standard deviations, over pixels that a robot covers wholly, of the difference from a picture
    of many paths; the sensor is noiseless but where its noise is told.

    Parameters
    ----------
    recipe
        Name of a recipe.
    images
        How many.
    backgrounds
        Folder of photos.
    """
    settings = settings_of(recipe, images=images, robots_max=1, empty_share=0.0)
    photos = photos_in(backgrounds)
    camera = camera_of(settings)
    shots: dict[str, list[Shot]] = {}
    for samples in (MANY_SAMPLES, 4, 8, 16):
        model = Model(None, settings.scale)
        with Renderer(ensure(say), model, workers=1, samples=samples) as renderer:
            world = World(
                settings, camera, renderer.radius_m, tuple(renderer.lights), _grey, photos
            )
            drawn = [draw_scene(world, k) for k in range(images)]
            calm = [replace(d.look, sensor=_noiseless(d.look.sensor)) for d in drawn]
            scenes = [(camera, d.robots, look) for d, look in zip(drawn, calm, strict=True)]
            shots[f"paths_{samples}"] = list(renderer.shots(scenes))
            if samples == MANY_SAMPLES:
                noisy = [(camera, d.robots, d.look) for d in drawn]
                shots["sensor"] = list(renderer.shots(noisy))
    exact = shots.pop(f"paths_{MANY_SAMPLES}")
    return {name: _difference(found, exact) for name, found in shots.items()}


def _grey(name: str) -> Picture:
    """(8, 16, 3) a panorama of nothing."""
    return np.full((8, 16, 3), 0.3, np.float32)


def _noiseless(sensor: Sensor) -> Sensor:
    return replace(sensor, shot_noise=0.0, read_noise=0.0)


def _difference(found: list[Shot], exact: list[Shot]) -> float:
    """Standard deviation where a robot covers pixels wholly."""
    apart = [
        (one.rgb.astype(float) - other.rgb)[(other.opacity == 255).any(axis=0)].ravel()
        for one, other in zip(found, exact, strict=True)
    ]
    return float(np.std(np.concatenate(apart)))


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _own_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def published_way(model: Path, backgrounds: Path, images: int, samples: int) -> dict[str, float]:
    """CPU seconds per image of the published way, start-up included, on our own scenes.

    Parameters
    ----------
    model
        crazyflie-published.blend.
    backgrounds
        Folder of photos.
    images
        How many.
    samples
        Light paths per pixel.
    """
    settings = replace(settings_of("synthetic_paper"), images=images, robots_max=1)
    world = World(
        settings,
        camera_of(settings),
        0.1,
        ("none",),
        _grey,
        None,
    )
    photos = sorted(backgrounds.glob("*.jpg"))
    listed = []
    for k in range(images):
        matrices = []
        for robot in draw_scene(world, k).robots:
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = robot.pose.camera_from_body, robot.pose.xyz_camera
            matrices.append(matrix.tolist())
        listed.append({"background": str(photos[k % len(photos)]), "robots": matrices})
    with tempfile.TemporaryDirectory() as folder:
        job = {"model": str(model), "samples": samples, "folder": folder, "images": listed}
        (Path(folder) / "job.json").write_text(json.dumps(job))
        before, begin = _children_s(), time.monotonic()
        subprocess.run(
            [ensure(say), PUBLISHED_WAY, Path(folder) / "job.json"],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        wall_s = time.monotonic() - begin
        cpu_s = _children_s() - before
    return {"cpu_s_per_image": cpu_s / images, "images_per_s": images / wall_s}


def ours(recipe: str, images: int, workers: int, **changes: object) -> dict[str, float]:
    """CPU seconds per image of ``dmrl render``, start-up and recording included.

    Parameters
    ----------
    recipe
        Name of a recipe.
    images
        How many.
    workers
        Blender processes.
    changes
        Settings over the recipe's.
    """
    with tempfile.TemporaryDirectory() as folder:
        settings = settings_of(recipe, images=images, workers=workers, **changes)
        before, own, begin = _children_s(), _own_s(), time.monotonic()
        run(Path(folder) / "out.mcap", settings)
        wall_s = time.monotonic() - begin
        workers_s, own_s = _children_s() - before, _own_s() - own
    return {
        "cpu_s_per_image": (workers_s + own_s) / images,
        "of_it_blender": workers_s / images,
        "images_per_s": images / wall_s,
    }


def memory(images: int) -> dict[str, float]:
    """Resident memory of this process and the workers early and late in one run, MB.

    Parameters
    ----------
    images
        How many to render; the first and last thousand, or third, are compared.
    """
    seen: list[float] = []
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(0.5):
            seen.append(_resident_mb())

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        rates = ours("synthetic_paper", images, 0)
    finally:
        stop.set()
        thread.join()
    third = len(seen) // 3
    first, last = np.median(seen[2 : third + 2]), np.median(seen[-third:])
    return {"first_mb": float(first), "last_mb": float(last), "growth": last / first - 1, **rates}


def _resident_mb() -> float:
    """Memory of the benchmark and its children."""
    own = os.getpid()
    total = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
            if int(stat.parent.name) == own or int(fields[1]) == own:
                total += int(fields[21])
        except (OSError, IndexError):
            continue  # it has ended meanwhile
    return total * os.sysconf("SC_PAGE_SIZE") / 1e6


def speed(model: Path, backgrounds: Path, images: int, rounds: int) -> dict[str, object]:
    """The published way, and ours with its model and with our own, turn by turn in one run.

    The first two take equal samples; what is called by a recipe's name is as that recipe says.

    Every way is timed with few and with many images; the difference is what an image costs
    without the start. What else runs on the machine then disturbs all ways alike.

    Parameters
    ----------
    model
        crazyflie-published.blend.
    backgrounds
        Folder of photos.
    images
        How many of ours in a round; the published way gets a tenth.
    rounds
        How often; the least and the median are told.
    """
    as_published = {"model": model, "scale": MM_PER_UNIT, "model_up": "y"}
    one = {"backgrounds": backgrounds, "robots_max": 1}
    ways: dict[str, tuple[Callable[[int], dict[str, float]], int]] = {
        "published way": (lambda n: published_way(model, backgrounds, n, SAMPLES), images // 10),
        "ours, published model": (
            lambda n: ours("synthetic_paper", n, 2, samples=SAMPLES, **one, **as_published),
            images,
        ),
        "ours, default model": (
            lambda n: ours("synthetic_paper", n, 2, samples=SAMPLES, **one),
            images,
        ),
        "synthetic_paper": (lambda n: ours("synthetic_paper", n, 2, **one), images),
        "synthetic_large": (lambda n: ours("synthetic_large", n, 2, **one), images),
    }
    found: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, (way, many) in ways.items():
            few, all_of_them = way(FEW), way(FEW + many)
            spent_s = [r["cpu_s_per_image"] * n for r, n in ((few, FEW), (all_of_them, FEW + many))]
            took_s = [n / r["images_per_s"] for r, n in ((few, FEW), (all_of_them, FEW + many))]
            without_start = {
                "cpu_s_without_start": (spent_s[1] - spent_s[0]) / many,
                "images_per_s_without_start": many / (took_s[1] - took_s[0]),
            }
            found[name].append({**all_of_them, **without_start})
    result: dict[str, object] = {"equal_samples": SAMPLES, "load": os.getloadavg()}
    for name, rates in found.items():
        result[name] = {
            key: {"least": min(values), "median": float(np.median(values)), "most": max(values)}
            for key in rates[0]
            if (values := [rate[key] for rate in rates])
        }
        result[f"published way / {name}"] = [
            theirs["cpu_s_without_start"] / rate["cpu_s_without_start"]
            for theirs, rate in zip(found["published way"], rates, strict=True)
        ]
    return result


def main() -> None:
    """Print the figures that were asked for, as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("reprojection", "grain", "speed", "memory"))
    parser.add_argument("--images", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--backgrounds", type=Path)
    asked = parser.parse_args()
    if asked.what == "reprojection":
        result: object = {p: reprojection(p, asked.images) for p in ("published", "himax")}
    elif asked.what == "memory":
        result = memory(asked.images)
    elif asked.backgrounds is None:
        sys.exit(f"{asked.what} needs --backgrounds DIR")
    elif asked.what == "grain":
        recipes = ("synthetic_paper", "synthetic_large")
        result = {r: grain(r, asked.images, asked.backgrounds) for r in recipes}
    elif asked.model is None:
        sys.exit("speed needs --model crazyflie-published.blend")
    else:
        result = speed(asked.model, asked.backgrounds, asked.images, asked.rounds)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
