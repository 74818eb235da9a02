"""``dmrl record``: logs and images of robots in flight, as a recording."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.guards.lazy_names import import_lazily
from dmrl.ingest.settings import RecordSettings as Settings
from dmrl.terminal.arguments import AsJson, Flat
from dmrl.terminal.tables import print_json, print_table

COLUMNS = ("from", "received", "lost", "broken", "connections")
DEFAULTS = Settings()
__getattr__ = import_lazily(__name__, {"run": "dmrl.ingest.live_session:record_session"})


def command(
    out: Path,
    /,
    *,
    robot: Annotated[list[str], Parameter(negative=())],
    settings: Flat[Settings] = DEFAULTS,
    view: Annotated[bool, Parameter(negative=())] = False,
    as_json: AsJson = False,
) -> None:
    """Record logs and images of flying Crazyflies, until Ctrl-C.

    Parameters
    ----------
    out
        Recording to write. Must not exist. While it runs it is OUT.partial.
    robot
        NAME=URI[,camera=HOST:PORT][,calibration=FILE.toml]; repeat for more robots.
    view
        Show it in rerun as it comes.
    """
    from dmrl.ingest.live_session import record_session
    from dmrl.live.robot_options import parse_robot

    robots = [parse_robot(text) for text in robot]
    with ExitStack() as window:
        show = None
        if view:
            from dmrl.viewer.window.live_view import LiveWindow

            cameras = [r.name for r in robots if r.camera]
            show = window.enter_context(LiveWindow([r.name for r in robots], cameras)).show
        result = record_session(out, robots, settings, show=show)
    rows = [(h.source, h.received, h.lost, h.broken, h.connections) for h in result.healths]
    if as_json:
        links = [dict(zip(COLUMNS, row, strict=True)) for row in rows]
        document = {"recording": str(out), "messages": result.messages, "links": links}
        print_json({**document, "cpu_share": round(result.cpu_share, 4)})
        return
    print_table(str(out), ("topic", "messages"), list(result.messages.items()))
    print_table("", COLUMNS, rows)
