"""``dmrl view``: recordings in rerun, as a file or as a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter, validators

from dmrl.errors import SettingError
from dmrl.terminal.arguments import Count, Flat, Strict
from dmrl.terminal.left_out import count_left_out
from dmrl.terminal.tables import count_things, print_line
from dmrl.viewer.settings import Settings, Web

DEFAULTS = Settings()
WEB = Web()
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
    from dmrl.viewer import save, screenshot

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
    flag_to: Annotated[Path | None, Parameter(name="--flag", group=OUTPUT)] = None,
    serve_web: Annotated[bool, Parameter(name="--serve", negative="", group=OUTPUT)] = False,
    time_s: Annotated[float | None, Parameter(name=["--time-s", "--time"])] = None,
    rank: Count = 1,
    strict: Strict = False,
    web: Flat[Web] = WEB,
    settings: Flat[Settings] = DEFAULTS,
) -> None:
    """Show recordings in rerun, or save them as an .rrd file or a picture.

    Labels, detections and maps lie over the image they belong to; several recordings share
    one timeline. A dataset is shown row by row, worst first if recordings with a model's
    detections stand beside it.

    Parameters
    ----------
    recording
        Recordings; or a dataset, and recordings that a model predicted on.
    save_to
        Write an .rrd file with its layout, for `rerun F.rrd`.
    screenshot_to
        Write a PNG picture. Needs no screen.
    flag_to
        Write the label desk of a dataset or of recordings: an HTML page to check, correct and
        flag labels. It saves recordings for dmrl dataset --corrections, and flags for --without.
    serve_web
        Show it in a browser.
    time_s
        Take the picture of the image nearest to this time, seconds from the start.
    rank
        Take the picture of this row of a dataset; 1 is the worst.
    strict
        End with an error if an image cannot be decoded. Without it, such images are left out and
        counted.
    """
    from dmrl.viewer import flag, save, screenshot, serve, view

    for path, suffix in ((save_to, ".rrd"), (screenshot_to, ".png"), (flag_to, ".html")):
        if path is not None and path.suffix != suffix:
            raise SettingError(
                f"{path}: --save writes .rrd, --screenshot .png, --flag .html. Name it so"
            )
    with count_left_out(strict=strict):
        if save_to is not None:
            count = save(recording, save_to, settings)
            print_line(f"{save_to}: {count_things(count, 'image')}")
        elif screenshot_to is not None:
            shown = screenshot(recording, screenshot_to, settings, time_s=time_s, rank=rank)
            print_line(f"{screenshot_to}: {shown}")
        elif flag_to is not None:
            count = flag(recording, flag_to, settings)
            print_line(f"{flag_to}: {count_things(count, 'row')}. Open it in a browser")
        elif serve_web:
            serve(recording, settings, web)
        else:
            view(recording, settings)
