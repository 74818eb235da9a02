"""Serve recordings as a page for a browser or a notebook.

The server listens on 127.0.0.1 only, unless another address is given.
"""

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

from dmrl.errors import SettingError
from dmrl.terminal.progress import say
from dmrl.terminal.signals import set_on_signal
from dmrl.viewer.session import prepare
from dmrl.viewer.settings import LOOPBACK, Settings, Web
from dmrl.viewer.window.viewer_process import (
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


WEB = Web()


def serve(paths: Sequence[Path], settings: Settings, web: Web = WEB) -> None:
    """Show recordings in a browser until Ctrl-C. Prints the address.

    Raises
    ------
    DatasetError, RecordingError
        If they cannot be read, or have nothing for the layout.
    SettingError
        If the recordings are empty at the requested time, or the port is in use.
    """
    with suppress(KeyboardInterrupt), page(paths, settings, web) as shown:
        shown.serve()


@contextmanager
def page(paths: Sequence[Path], settings: Settings, web: Web = WEB) -> Iterator["Page"]:
    """Serve a page with recordings until the end of the block.

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
        Selects images and layout.
    web
        Address of the server.

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
        """Send all data; the page shows the first meanwhile."""
        stream_to(self._show, self._viewer, self._data_port, self._host)

    def serve(self) -> None:
        """Print the address, send the data and wait for Ctrl-C or a kill."""
        # An exception would be lost in a destructor of rerun's, which talks to the server.
        with set_on_signal(self._viewer.ended):
            say(f"{self.url} (Ctrl-C ends it)")
            self.fill()
            self._viewer.wait()

    def close(self) -> None:
        """Stop the server."""
        self._viewer.close()

    def _repr_html_(self) -> str:
        self.fill()
        return f'<iframe src="{self.url}" width="100%" height="{FRAME_PX}"></iframe>'
