"""``dmrl view``: recordings in rerun, or what it would show as a file or a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter, validators

from dmrl.errors import SettingError
from dmrl.viewer import Settings, save, screenshot, serve, view

DEFAULTS = Settings()
OUTPUT = Group("Output, at most one", validator=validators.mutually_exclusive)


def run(recordings: Sequence[Path], out: Path, settings: Settings) -> None:
    """Write a picture of the first image (``.png``), or everything shown (``.rrd``).

    Raises
    ------
    OutputError
        If ``out`` exists or cannot be written.
    RecordingError
        If no recording has images, or one cannot be read.
    SettingError
        If ``out`` has another suffix, or no image lies in the time asked for.
    """
    if out.suffix == ".png":
        screenshot(recordings, out, settings)
    elif out.suffix == ".rrd":
        save(recordings, out, settings)
    else:
        raise SettingError(f"{out}: view writes .png and .rrd. Name one of them")


def command(
    recording: list[Path],
    /,
    *,
    save_to: Annotated[Path | None, Parameter(name="--save", group=OUTPUT)] = None,
    screenshot_to: Annotated[Path | None, Parameter(name="--screenshot", group=OUTPUT)] = None,
    serve_web: Annotated[bool, Parameter(name="--serve", negative="", group=OUTPUT)] = False,
    time_s: Annotated[float | None, Parameter(name=["--time-s", "--time"])] = None,
    settings: Annotated[Settings, Parameter(name="*")] = DEFAULTS,
) -> None:
    """Show recordings in rerun, or save what it would show.

    Labels, detections and maps lie over the image they belong to; several recordings share
    one timeline.

    Parameters
    ----------
    recording
        Recordings; one of them at least with images.
    save_to
        Write an .rrd file with its layout, for `rerun F.rrd`.
    screenshot_to
        Write a PNG picture. Needs no screen.
    serve_web
        Show it in a browser of this computer.
    time_s
        Take the picture of the image nearest to this time, seconds from the start.
    """
    if save_to is not None:
        count = save(recording, save_to, settings)
        print(f"{save_to}: {count} images")
    elif screenshot_to is not None:
        shown_s = screenshot(recording, screenshot_to, settings, time_s=time_s)
        print(f"{screenshot_to}: at {shown_s:.3f} s")
    elif serve_web:
        serve(recording, settings)
    else:
        view(recording, settings)
