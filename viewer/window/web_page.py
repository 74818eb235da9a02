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
from dmrl.viewer.session import prepare_show
from dmrl.viewer.settings import LOOPBACK, Settings, Web
from dmrl.viewer.window.viewer_process import (
    ViewerProcess,
    build_command,
    find_free_port,
    last_line,
    require_free_port,
    stream_to,
    wait_until_listening,
)

ANY_ADDRESS = ("0.0.0.0", "::")
NOTEBOOK_HEIGHT_PX = 700


DEFAULT_ADDRESS = Web()


def serve(paths: Sequence[Path], settings: Settings, web: Web = DEFAULT_ADDRESS) -> None:
    """Show recordings in a browser until Ctrl-C. Prints the address.

    Raises
    ------
    DatasetError, RecordingError
        If they cannot be read, or have nothing for the layout.
    SettingError
        If the recordings are empty at the requested time, or the port is in use.
    """
    with suppress(KeyboardInterrupt), open_page(paths, settings, web) as shown:
        shown.serve()


@contextmanager
def open_page(
    paths: Sequence[Path], settings: Settings, web: Web = DEFAULT_ADDRESS
) -> Iterator["Page"]:
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

    def __init__(
        self, paths: Sequence[Path], settings: Settings, web: Web = DEFAULT_ADDRESS
    ) -> None:
        self._show = prepare_show(paths, settings)
        self._data_port = find_free_port(web.bind)
        port = web.port or find_free_port(web.bind)
        require_free_port(web.bind, port)
        host = socket.gethostname() if web.bind in ANY_ADDRESS else web.bind
        source = quote(f"rerun+http://{host}:{self._data_port}/proxy", safe="")
        self.url = f"http://{host}:{port}?url={source}"
        ports = ("--port", str(self._data_port), "--web-viewer-port", str(port))
        allowed = ("--cors-allow-origin", f"http://{host}:{port}", "--server-memory-limit", "75%")
        words = build_command(web.bind, "--serve-web", *ports, *allowed)
        self._host = LOOPBACK if web.bind in ANY_ADDRESS else web.bind
        self._viewer = ViewerProcess(words)
        try:
            if not wait_until_listening(self._viewer, self._host, self._data_port):
                said = last_line(self._viewer.read_errors())
                raise SettingError(
                    f"rerun's server stopped: {said}. Choose another --port or --bind"
                )
        except BaseException:
            self.close()
            raise

    def send_data(self) -> None:
        """Send all data; the page shows the first meanwhile."""
        stream_to(self._show, self._viewer, self._data_port, self._host)

    def serve(self) -> None:
        """Print the address, send the data and wait for Ctrl-C or a kill."""
        # An exception would be lost in a destructor of rerun's, which talks to the server.
        with set_on_signal(self._viewer.ended):
            say(f"{self.url} (Ctrl-C ends it)")
            self.send_data()
            self._viewer.wait()

    def close(self) -> None:
        """Stop the server."""
        self._viewer.close()

    def _repr_html_(self) -> str:
        self.send_data()
        return f'<iframe src="{self.url}" width="100%" height="{NOTEBOOK_HEIGHT_PX}"></iframe>'
