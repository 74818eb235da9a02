"""Output maps of a chip for images, in a folder beside them.

``gap8-maps/posNNNNN.ppm`` and ``depNNNNN.ppm`` beside ``imgNNNNN.ppm`` are binary PGM, one byte
per cell of 8 x 8 pixels, with 0 stored as 128. Both outputs share one scale: a level is
`LEVEL_STEP`, in the logit of the confidence and in the logarithm of the depth (metres).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import SourceError
from dmrl.geometry.frames import STRIDE_PX
from dmrl.images import codec
from dmrl.samples.sample import Sample

MAPS_FOLDER = "gap8-maps"
LEVEL_STEP = 0.211
"""Size of a quantization level of the published network on the GAP8."""
MAP_PREFIXES = ("pos", "dep")


def load_chip_maps(picture: Path, time_ns: int, robot: str) -> Sample | None:
    """Load the maps of an image as a GridMap at its time; None if it has none.

    Parameters
    ----------
    picture
        Path of the image.
    time_ns, robot
        Its log time, and the robot whose camera took it.

    Raises
    ------
    SourceError
        If one of the two maps is missing or cannot be read, or their sizes differ.
    """
    number = picture.stem.removeprefix("img")
    files = [picture.parent / MAPS_FOLDER / f"{name}{number}.ppm" for name in MAP_PREFIXES]
    if not any(file.is_file() for file in files):
        return None
    logit, log_depth = (LEVEL_STEP * _load_levels(file) for file in files)
    if logit.shape != log_depth.shape:
        raise SourceError(f"{files[1]} differs in size from {files[0].name}. Remove both")
    maps = np.stack((1 / (1 + np.exp(-logit)), np.exp(log_depth)))
    fields = {
        "rows": logit.shape[0],
        "cols": logit.shape[1],
        "channels": ("confidence", "depth_m"),
        "data": maps.astype("<f4").tobytes(),
        "stride_px": STRIDE_PX,
    }
    return Sample(time_ns, topics.GRID(robot), "GridMap", fields)


def _load_levels(file: Path) -> NDArray[np.float64]:
    """Load the (rows, cols) levels of a map, -128 to 127."""
    try:
        data = file.read_bytes()
    except OSError:
        raise SourceError(f"no {file} beside its other map. Add it, or remove both") from None
    return codec.decode(data, file)[..., 0].astype(float) - 128.0
