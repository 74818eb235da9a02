"""Serve recordings as a page for a browser or a notebook.

The server listens on 127.0.0.1 only, unless another address is given.
"""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from dmrl.terminal.progress import say
from dmrl.terminal.signals import set_on_signal
from dmrl.viewer.session import prepare_show, write_rrd
from dmrl.viewer.settings import Settings, Web
from dmrl.viewer.window.page_server import PageServer

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
    with suppress(KeyboardInterrupt), open_page(paths, settings, web) as page:
        page.serve()


@contextmanager
def open_page(
    paths: Sequence[Path], settings: Settings, web: Web = DEFAULT_ADDRESS
) -> Iterator["Page"]:
    """Serve a page with recordings until the end of the block.

    Raises
    ------
    As `serve`.
    """
    page = Page(paths, settings, web)
    try:
        yield page
    finally:
        page.close()


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
        self._server = PageServer(web)
        self._ended = threading.Event()
        self.url = self._server.url

    def send_data(self) -> None:
        """Write all data, once; the page shows the first meanwhile."""
        data = self._server.data
        if not data.complete.is_set():
            write_rrd(self._show, data, lambda: not self._ended.is_set())
            data.complete.set()

    def serve(self) -> None:
        """Print the address, write the data and wait for Ctrl-C or a kill."""
        # An exception would be lost in a destructor of rerun's.
        with set_on_signal(self._ended):
            say(f"{self.url} (Ctrl-C ends it)")
            self.send_data()
            self._ended.wait()

    def close(self) -> None:
        """Stop the server."""
        self._ended.set()
        self._server.close()

    def _repr_html_(self) -> str:
        self.send_data()
        return f'<iframe src="{self.url}" width="100%" height="{NOTEBOOK_HEIGHT_PX}"></iframe>'
