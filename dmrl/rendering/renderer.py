"""Renderer of robots with Blender worker processes.

with Renderer(ensure_environment(report), RobotModel()) as renderer:
    for shot in renderer.render_shots((camera, robots, look) for ...):
        ...
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from dmrl.errors import SettingError
from dmrl.geometry.frames import Array, Camera
from dmrl.guards.posix import count_cores
from dmrl.rendering.backgrounds.panorama import Panorama
from dmrl.rendering.compositing import compose_shot
from dmrl.rendering.robots.crazyflie import BLADE_HALF_WIDTH_M, CRAZYFLIE, ROTOR_STEP_RAD
from dmrl.rendering.robots.primitives import RobotDesign
from dmrl.rendering.shot import Layer, Look, Robot, Shot, build_requests
from dmrl.rendering.worker_pool import Worker, WorkerPool, WorkerStart

MODEL_SUFFIXES = (".blend", ".glb", ".gltf", ".obj", ".stl")
"""Suffixes of model files that Blender can import."""
PANORAMA_SUFFIXES = (".exr", ".hdr")
MIN_ROBOT_SIZE_M, MAX_ROBOT_SIZE_M = 0.01, 3.0
"""Size of a robot, metres: smallest and largest."""
DEFAULT_SAMPLES = 8
LIGHT_BOUNCES = 2

Scene = tuple[Camera, Sequence[Robot], Look]


@dataclass(frozen=True, slots=True)
class RobotModel:
    """Shape of the robots.

    Parameters
    ----------
    path
        .blend, .glb, .obj or .stl file, or None for ``design``.
    scale
        Metres per unit of the file. Without a file, times life size.
    up
        Axis of the file that points up. auto: y of .obj and .glb, z of .stl and .blend.
    centre
        Reference point of the labels: the middle of the model's box, or the file's origin.
    design
        Built-in robot that is used without a file.
    """

    path: Path | None = None
    scale: float = 1.0
    up: Literal["auto", "y", "z"] = "auto"
    centre: Literal["box", "origin"] = "box"
    design: RobotDesign = CRAZYFLIE


def _build_start(
    python: Path, model: RobotModel, lights: Sequence[str], samples: int
) -> WorkerStart:
    head: dict[str, Any] = {
        "samples": samples,
        "bounces": LIGHT_BOUNCES,
        "lights": list(lights),
        "model": None if model.path is None else str(model.path),
        "model_scale": model.scale,
        "model_up": model.up,
        "model_centre": model.centre,
        "materials": model.design.materials,
        "blade_half_width_m": BLADE_HALF_WIDTH_M,
        "between_rotors_rad": ROTOR_STEP_RAD,
    }
    if model.path is not None:
        return WorkerStart(python, head)
    mesh = model.design.build_mesh()
    arrays = {"vertices": mesh.vertices * model.scale, "faces": mesh.faces}
    return WorkerStart(python, head, {**arrays, "material": mesh.material, "rotor": mesh.rotor})


class Renderer:
    """Pool of workers that share one robot model and a set of panoramas.

    Parameters
    ----------
    python
        Python of Blender's environment, see ``blender_environment.ensure_environment``.
    model
        Robot model.
    lights
        Paths of panoramas (.exr, .hdr). None uses those that ship with Blender.
    workers
        Number of processes. 0 uses one per core.
    samples
        Light paths per pixel.

    Raises
    ------
    BlenderError
        If Blender does not start, or cannot import the model.
    SettingError
        If the model is missing, or the scale makes a robot that is no small drone.
    """

    def __init__(
        self,
        python: Path,
        model: RobotModel,
        *,
        lights: Sequence[Path] | None = None,
        workers: int = 0,
        samples: int = DEFAULT_SAMPLES,
    ) -> None:
        _check_model(model)
        self.lights = [
            str(p) for p in (list_shipped_panoramas(python) if lights is None else lights)
        ]
        self.pool = WorkerPool(
            _build_start(python, model, self.lights, samples), workers or count_cores()
        )
        self.version = self.pool.version
        self.points = _hull_points(self.pool.points)
        self.box = np.array([self.pool.points.min(axis=0), self.pool.points.max(axis=0)])
        """(2, 3) minimum and maximum x, y and z of the robot, body frame, metres."""
        size_m = float(np.ptp(self.box, axis=0).max())
        if not MIN_ROBOT_SIZE_M <= size_m <= MAX_ROBOT_SIZE_M:
            self.pool.__exit__()
            raise SettingError(_size_error(model, size_m))

    @property
    def radius_m(self) -> float:
        """Radius of a ball about the origin that contains a robot, metres."""
        return float(np.linalg.norm(self.points, axis=1).max())

    def render_shots(self, scenes: Iterable[Scene]) -> Iterator[Shot]:
        """Yield the shots of scenes, in their order. Few scenes are read ahead.

        Raises
        ------
        BlenderError
            If Blender exits repeatedly on one scene.
        """
        return self.pool.map(self._render_shot, scenes)

    def _render_shot(self, worker: Worker, scene: Scene) -> Shot:
        camera, robots, look = scene
        layers = {}
        for number, asked in build_requests(camera, robots, look, self.points):
            _, arrays = worker.request(asked)
            left, top, _, _ = asked["crop_px"]
            layers[number] = Layer(left, top, arrays["light"], arrays["depth"])
        return compose_shot(camera, robots, look, layers)

    def load_panorama(self, name: str) -> Panorama:
        """Load a panorama by its name."""
        _, arrays = self.pool.call(lambda worker: worker.request({"panorama": name}))
        return Panorama(arrays["panorama"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.pool.__exit__()


def list_shipped_panoramas(python: Path) -> list[Path]:
    """List the panoramas that ship with Blender, sorted."""
    found = python.parent.parent.glob(
        "lib/python*/site-packages/bpy/*/datafiles/studiolights/world"
    )
    return sorted(path for folder in found for path in folder.glob("*.exr"))


def list_panoramas(folder: Path) -> list[Path]:
    """List the panoramas of a folder, sorted.

    Raises
    ------
    SettingError
        If the folder does not exist or contains no panorama.
    """
    if not folder.is_dir():
        raise SettingError(f"no folder {folder} of panoramas. Check the key lights")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in PANORAMA_SUFFIXES)
    if not found:
        kinds = ", ".join(PANORAMA_SUFFIXES)
        raise SettingError(f"{folder} contains no panorama ({kinds}). Use another for lights")
    return found


def _size_error(model: RobotModel, size_m: float) -> str:
    """Return the error text for a robot of this size."""
    limits = f"they must be {MIN_ROBOT_SIZE_M:g} to {MAX_ROBOT_SIZE_M:g} m"
    if model.path is None:
        return (
            f"the robot that dmrl draws, {model.scale:g} times life size, is {size_m:.3g} m; "
            f"{limits}. Pass the --model of this scale, or use --scale 1"
        )
    return (
        f"--scale {model.scale:g} makes robots of {size_m:.3g} m; {limits}. Change --scale, "
        "metres per unit of the model"
    )


def _check_model(model: RobotModel) -> None:
    if model.path is not None:
        if not model.path.is_file():
            raise SettingError(f"no model {model.path}. Check --model")
        if model.path.suffix.lower() not in MODEL_SUFFIXES:
            raise SettingError(
                f"{model.path} is not a model. Use one of {', '.join(MODEL_SUFFIXES)}"
            )
    if not np.isfinite(model.scale) or model.scale <= 0:
        raise SettingError(f"--scale {model.scale:g} is not above 0. Pass metres per unit")


def _hull_points(points: Array) -> Array:
    """Return the farthest points in 400 directions. Their hull nearly contains all points."""
    k = np.arange(400) + 0.5  # directions on a golden spiral
    z, turn = 1 - 2 * k / 400, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z * z)
    directions = np.column_stack([np.cos(turn) * ring, np.sin(turn) * ring, z])
    return np.asarray(points[np.unique((points @ directions.T).argmax(axis=0))])
