"""C of the pilot."""

from collections.abc import Mapping
from pathlib import Path

from dmrl import __version__
from dmrl.deploy.c.templating import fill_template
from dmrl.geometry.frames import Camera

PILOT_BYTES = 1256
"""Memory of the pilot's state, which the caller owns; it has no other."""


def write_pilot(
    folder: Path, camera: Camera, constants: Mapping[str, float], detections_max: int
) -> None:
    """Write pilot.c and pilot.h.

    Parameters
    ----------
    folder
        Folder of the files.
    camera
        Pinhole camera of the detections.
    constants, detections_max
        Those of the reference, `dmrl.flight.onboard_pilot`.
    """
    lens = {"FX": camera.fx_px, "FY": camera.fy_px, "CX": camera.cx_px, "CY": camera.cy_px}
    values = {name: repr(value) for name, value in {**constants, **lens}.items()}
    values |= {"DETECTIONS_MAX": str(detections_max), "version": __version__}
    for name in ("pilot.c", "pilot.h"):
        (folder / name).write_text(fill_template(name, **values), encoding="utf-8")
