"""Networks of other people: one ONNX file, with maps or boxes as its output.

docs/benchmark.md says which inputs and outputs are understood.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.backends import Images
from dmrl.deploy.int8.graph import rgb_to_grey
from dmrl.deploy.onnx.runtime import open_session
from dmrl.errors import ModelError
from dmrl.geometry.frames import AIDECK_PINHOLE, STRIDE_PX, is_inside
from dmrl.learn.inference.decode_grids import Grids

ROBOT_WIDTH_M = 0.13
"""Width of a Crazyflie with its propellers: a box without a depth is so wide."""
DEFAULT_THRESHOLD = 0.5
Array = NDArray[np.float64]


class SubmittedNetwork:
    """An ONNX file of unknown origin as a function from images to grids.

    Parameters
    ----------
    file
        The ONNX file. Metadata ``threshold`` is the confidence from which a detection counts.

    Raises
    ------
    ModelError
        If it cannot be run, or its inputs or outputs are of no kind that is understood.
    """

    def __init__(self, file: Path) -> None:
        self._file, self._session = file, open_session(file, file)
        inputs = self._session.get_inputs()
        shape = list(inputs[0].shape) if len(inputs) == 1 else []
        if len(shape) != 4 or not {shape[1], shape[3]} & {1, 3}:
            raise self._refuse("an input of N x C x H x W or N x H x W x C, C 1 or 3, alone")
        self._input, self._first = inputs[0], shape[1] in (1, 3)
        self._grey = (shape[1] if self._first else shape[3]) == 1
        height, width = shape[2:] if self._first else shape[1:3]
        fixed = isinstance(height, int) and isinstance(width, int)
        self.size_px = (width, height) if fixed else None
        self.names = [output.name for output in self._session.get_outputs()]
        said = self._session.get_modelmeta().custom_metadata_map.get("threshold", "")
        try:
            self.threshold = float(said or DEFAULT_THRESHOLD)
        except ValueError:
            self.threshold = np.nan
        if not 0 <= self.threshold <= 1:
            raise ModelError(f"{file}: its metadata threshold is {said!r:.40}. Give 0 to 1")

    def __call__(self, images: Images) -> Grids:
        """Return the grids of (N, height, width, 3) RGB images."""
        each = [self._look(image) for image in images]
        confidence, depth_m, offset = (np.stack(part) for part in zip(*each, strict=True))
        return Grids(confidence.astype(np.float32), depth_m.astype(np.float32), offset)

    def _look(self, image: NDArray[np.uint8]) -> tuple[Array, Array, Array]:
        seen = rgb_to_grey(image[None]) if self._grey else image[None]
        data = np.ascontiguousarray(seen.transpose(0, 3, 1, 2) if self._first else seen)
        if self._input.type != "tensor(uint8)":
            data = (data / 255.0).astype("f2" if "float16" in self._input.type else "f4")
        try:
            values = self._session.run(self.names, {self._input.name: data})
        except Exception as e:  # onnxruntime's exceptions have no common base
            raise ModelError(f"{self._file}: {' '.join(str(e).split())}. Check its input") from None
        named = zip(self.names, values, strict=True)
        found = {name: np.asarray(value, np.float64) for name, value in named}
        grid = (image.shape[0] // STRIDE_PX, image.shape[1] // STRIDE_PX)
        maps = _maps_to_grids(found, grid)
        if maps is not None and np.isnan(maps[0]).any():
            raise ModelError(f"{self._file}: its confidence is NaN. Check weights and input range")
        return maps or self._boxes_to_grids(found, grid)

    def _boxes_to_grids(
        self, found: dict[str, Array], grid: tuple[int, int]
    ) -> tuple[Array, Array, Array]:
        """Return boxes as grids: each in the cell of its centre, the best one of a cell."""
        rows = found[self.names[0]]
        if {"boxes", "scores"} <= set(found):
            scores = found["scores"].reshape(-1, 1)
            rows = np.hstack([found["boxes"].reshape(len(scores), 4), scores])
        rows = rows.reshape(-1, rows.shape[-1]) if rows.ndim in (2, 3) else rows
        if rows.ndim != 2 or rows.shape[1] not in (5, 6):
            raise self._refuse(
                f"outputs confidence and depth_m of {grid[0]} x {grid[1]} cells, or boxes: left, "
                "top, right, bottom, score"
            )
        rows = rows[np.isfinite(rows).all(axis=1)]
        rows = rows[np.argsort(rows[:, 4], kind="stable")]  # the best is written last
        high, wide = grid
        at = (rows[:, :2] + rows[:, 2:4]) / 2 / STRIDE_PX
        inside = is_inside(at, wide, high)
        rows, at = rows[inside], at[inside]
        col, row = at.astype(int).T
        confidence, depth = np.zeros((high, wide)), np.ones((high, wide))
        offset = np.zeros((2, high, wide))
        confidence[row, col] = np.clip(rows[:, 4], 0, 1)
        width_px = np.maximum(rows[:, 2] - rows[:, 0], 1.0)
        depth[row, col] = AIDECK_PINHOLE.fx_px * ROBOT_WIDTH_M / width_px
        offset[:, row, col] = at.T - (col + 0.5, row + 0.5)
        return confidence, depth, offset

    def _refuse(self, wanted: str) -> ModelError:
        said: list[Any] = [(i.name, i.shape) for i in self._session.get_inputs()]
        said += [(o.name, o.shape) for o in self._session.get_outputs()]
        return ModelError(f"{self._file} has {said}. It needs {wanted}; see docs/benchmark.md")


def _maps_to_grids(
    found: dict[str, Array], grid: tuple[int, int]
) -> tuple[Array, Array, Array] | None:
    """Return confidence, depth and offset, if the outputs are maps of this size."""
    maps = {name: value.reshape(grid) for name, value in found.items()
            if value.shape[-2:] == grid and value.size == grid[0] * grid[1]}  # fmt: skip
    confidence, depth = maps.get("confidence"), maps.get("depth_m")
    if "confidence_logit" in maps:
        confidence = 1 / (1 + np.exp(-np.clip(maps["confidence_logit"], -60, 60)))
    if "log_depth" in maps:
        depth = np.exp(np.clip(maps["log_depth"], -20, 20))
    if confidence is None or depth is None:
        return None
    nothing = np.zeros(grid)
    offset = np.stack([maps.get(name, nothing) for name in ("offset_u", "offset_v")])
    return confidence, depth, offset
