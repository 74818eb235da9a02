"""Settings of the viewer and its web page, the flags of ``dmrl view``; nothing heavy."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter, validators

from dmrl.terminal.arguments import Robot
from dmrl.viewer.views import LAYOUT_NAMES

LOOPBACK = "127.0.0.1"
if TYPE_CHECKING:
    Layout = str
else:
    Layout = Literal[("auto", *LAYOUT_NAMES, "dataset")]
Pixels = Annotated[float | None, Parameter(validator=validators.Number(gte=0))]


@dataclass(frozen=True, slots=True)
class Settings:
    """Images and layout of a viewer.

    Parameters
    ----------
    layout
        image: images and maps. flight: 3D, plots and images. compare: two models, one recording
        each. dataset: a dataset, worst first. auto: chosen by content.
    robot
        Only images and measurements of this robot. Without it: every robot, in compare the first.
    from_s
        Start of what is shown, seconds from the start of the earliest recording.
    to_s
        End of what is shown, seconds from the same start. Images of this time are not shown.
    every
        Show one image in this many, with its labels and detections.
    depth_max_m
        Depth of the last colour of depth maps, metres. The first is 0 m.
    overlay
        Lay the maps over the image, scaled up smoothly.
    most
        dataset: largest number of rows shown. Without it, 200; on the label desk, all.
    split
        dataset: only rows of this split.
    error_from_px
        dataset: only rows with an error of at least this, pixels.
    error_to_px
        dataset: only rows with a smaller error, pixels.
    """

    layout: Layout = "auto"
    robot: Robot | None = None
    from_s: Annotated[float | None, Parameter(name=["--from-s", "--from"])] = None
    to_s: Annotated[float | None, Parameter(name=["--to-s", "--to"])] = None
    every: Annotated[int, Parameter(validator=validators.Number(gte=1))] = 1
    depth_max_m: Annotated[float, Parameter(validator=validators.Number(gt=0))] = 3.0
    overlay: bool = False
    most: Annotated[int | None, Parameter(validator=validators.Number(gte=1))] = None
    split: str | None = None
    error_from_px: Pixels = None
    error_to_px: Pixels = None


@dataclass(frozen=True, slots=True)
class Web:
    """Address of the server.

    Parameters
    ----------
    bind
        Network address to listen on. Only 127.0.0.1 is closed to other computers.
    port
        Port of the page. None: any free port.
    """

    bind: str = LOOPBACK
    port: Annotated[int | None, Parameter(validator=validators.Number(gte=1, lte=65535))] = None
