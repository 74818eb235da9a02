"""A page with recordings for a browser or a notebook.

It is served on 127.0.0.1 only, unless told otherwise.
"""

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from cyclopts import Parameter, validators

from dmrl.errors import SettingError
from dmrl.terminal.progress import say
from dmrl.terminal.signals import ended_by_signal
from dmrl.viewer.selection import Settings
from dmrl.viewer.session import prepare
from dmrl.viewer.window.viewer_process import (
    LOOPBACK,
    Viewer,
    command,
    free_port,
    last_line,
    listens,
    require_free,
    stream_to,
)

ANYWHERE = ("0.0.0.0", "::")
FRAME_PX = 700


@dataclass(frozen=True, slots=True)
class Web:
    """Where a page is served.

    Parameters
    ----------
    bind
        Address of the network to listen on. Only on 127.0.0.1 nobody else can look.
    port
        Of the page. None: any that is free.
    """

    bind: str = LOOPBACK
    port: Annotated[int | None, Parameter(validator=validators.Number(gte=1, lte=65535))] = None


WEB = Web()


def serve(paths: Sequence[Path], settings: Settings, web: Web = WEB) -> None:
    """Show recordings in a browser, until Ctrl-C. Prints the address.

    Raises
    ------
    DatasetError, RecordingError
        If they cannot be read, or lack what the layout shows.
    SettingError
        If nothing lies in the time asked for, or the port is in use.
    """
    with suppress(KeyboardInterrupt), page(paths, settings, web) as shown:
        shown.serve()


@contextmanager
def page(paths: Sequence[Path], settings: Settings, web: Web = WEB) -> Iterator["Page"]:
    """A page with recordings that is served as long as the block lasts.

    Raises
    ------
    As `serve`.
    """
    opened = Page(paths, settings, web)
    try:
        yield opened
    finally:
        opened.close()


class Page:
    """A page with recordings, served until it is closed. A notebook shows it in the cell.

    Parameters
    ----------
    paths
        Recordings, or a dataset.
    settings
        What is shown.
    web
        Where it is served.

    Raises
    ------
    As `serve`.
    """

    def __init__(self, paths: Sequence[Path], settings: Settings, web: Web = WEB) -> None:
        self._show = prepare(paths, settings)
        self._data_port = free_port(web.bind)
        port = web.port or free_port(web.bind)
        require_free(web.bind, port)
        host = socket.gethostname() if web.bind in ANYWHERE else web.bind
        source = quote(f"rerun+http://{host}:{self._data_port}/proxy", safe="")
        self.url = f"http://{host}:{port}?url={source}"
        ports = ("--port", str(self._data_port), "--web-viewer-port", str(port))
        allowed = ("--cors-allow-origin", f"http://{host}:{port}", "--server-memory-limit", "75%")
        words = command(web.bind, "--serve-web", *ports, *allowed)
        self._host = LOOPBACK if web.bind in ANYWHERE else web.bind
        self._viewer = Viewer(words)
        try:
            if not listens(self._viewer, self._host, self._data_port):
                said = last_line(self._viewer.said())
                raise SettingError(
                    f"rerun's server stopped: {said}. Choose another --port or --bind"
                )
        except BaseException:
            self.close()
            raise

    def fill(self) -> None:
        """Send everything that is shown; the page can be looked at meanwhile."""
        stream_to(self._show, self._viewer, self._data_port, self._host)

    def serve(self) -> None:
        """Print the address, fill the page and wait for Ctrl-C, or a kill."""
        # An exception would be lost in a destructor of rerun's, which talks to the server.
        with ended_by_signal(self._viewer.ended):
            say(f"{self.url} (Ctrl-C ends it)")
            self.fill()
            self._viewer.wait()

    def close(self) -> None:
        """End the server."""
        self._viewer.close()

    def _repr_html_(self) -> str:
        self.fill()
        return f'<iframe src="{self.url}" width="100%" height="{FRAME_PX}"></iframe>'
