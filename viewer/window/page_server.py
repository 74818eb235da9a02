"""HTTP server of one page: rerun's web viewer and the data that it shows.

rerun's own server has an open data port, which any page that rebinds its name to this computer can
read, and its page calls four other hosts. This server answers only under a secret path and only
requests whose Host is its own. Its Content-Security-Policy keeps the page from calling other hosts.
"""

import re
import secrets
import time
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from socket import AF_INET, AF_INET6, gethostname
from tempfile import TemporaryFile
from threading import Event, Lock, Thread
from urllib.parse import quote

from dmrl.errors import SettingError
from dmrl.viewer.settings import LOOPBACK, Web
from dmrl.viewer.window.viewer_process import (
    build_command,
    find_free_port,
    last_line,
    run_viewer,
    wait_until_listening,
)

ANY_ADDRESS = ("0.0.0.0", "::")
DATA_NAME = "dmrl.rrd"
PAGE_FILES = {
    "": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "favicon.ico": "image/x-icon",
}
"""Files of rerun's web viewer, and their media types."""
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src data:; "
        "connect-src 'self' data: blob:; worker-src 'self' blob:; base-uri 'none'; "
        "form-action 'none'"
    ),
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
BLOCK_BYTES = 1 << 18
POLL_INTERVAL_S = 0.05
CLIENT_TIMEOUT_S = 60.0
"""Time after which a silent client is disconnected, seconds."""


class DataFile:
    """A file without a name that is served while it is written; it vanishes with the process."""

    def __init__(self) -> None:
        self.file = TemporaryFile()  # noqa: SIM115 - closed with the server
        self.complete = Event()
        self._lock = Lock()
        self._at = 0

    @property
    def name(self) -> str:
        """Name for errors."""
        return "the temporary folder"

    def write(self, block: bytes) -> int:
        """Append bytes."""
        with self._lock:
            self.file.seek(self._at)
            self.file.write(block)
            self._at += len(block)
        return len(block)

    def flush(self) -> None:
        """Pass appended bytes to the system."""
        self.file.flush()

    def iter_blocks(self) -> Iterator[bytes]:
        """Yield the content from the start, as it is written, until it is complete."""
        at = 0
        while True:
            last = self.complete.is_set()
            with self._lock:
                self.file.seek(at)
                block = self.file.read(BLOCK_BYTES)
            if block:
                at += len(block)
                yield block
            elif last:
                return
            else:
                time.sleep(POLL_INTERVAL_S)


class PageServer:
    """Server of the page, from its construction until it is closed.

    Parameters
    ----------
    web
        Address to listen on.

    Raises
    ------
    SettingError
        If the address is not this computer's, the port is in use, or rerun does not start.
    """

    def __init__(self, web: Web) -> None:
        port = find_free_port(web.bind, web.port)
        host = gethostname() if web.bind in ANY_ADDRESS else web.bind
        token = secrets.token_urlsafe(16)
        address = f"http://{f'[{host}]' if ':' in host else host}:{port}/{token}/"
        self.url = f"{address}?url={quote(address + DATA_NAME, safe='')}&persist=0"
        files = _load_viewer_files()
        self.data = DataFile()
        handler = partial(_Handler, f"/{token}/", _list_hosts(web.bind), files, self.data)
        family = AF_INET6 if ":" in web.bind else AF_INET
        kind = type("_Server", (ThreadingHTTPServer,), {"address_family": family})
        self._server = kind((web.bind, port), handler)
        self._server.daemon_threads = True
        Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Stop the server."""
        self.data.complete.set()
        self._server.shutdown()
        self._server.server_close()
        self.data.file.close()


def _list_hosts(bind: str) -> frozenset[str]:
    """Return the values of Host, without the port, that a request may have."""
    own = {LOOPBACK, "localhost", "[::1]", f"[{bind}]" if ":" in bind else bind}
    return frozenset(own | ({gethostname().lower(), ""} if bind in ANY_ADDRESS else set()))


def _is_allowed(host: str, allowed: frozenset[str]) -> bool:
    """Return whether a Host header is one of this server's.

    A server for a whole network is reached by any address of this computer, hence by numbers. A
    page that rebinds its name sends that name.
    """
    name = re.sub(r":\d+$", "", host.strip().lower())
    if name in allowed and name:
        return True
    with suppress(ValueError):
        return "" in allowed and bool(ip_address(name.strip("[]")))
    return False


def _load_viewer_files() -> dict[str, bytes]:
    """Read the files of rerun's web viewer, which are part of its program.

    Raises
    ------
    SettingError
        If the program does not start.
    """
    port = find_free_port(LOOPBACK)
    # With an address to show, rerun serves its files only and opens no data port.
    words = ("--serve-web", "--web-viewer-port", str(port), f"http://{LOOPBACK}:9/{DATA_NAME}")
    with run_viewer(build_command(LOOPBACK, *words)) as viewer:
        if not wait_until_listening(viewer, LOOPBACK, port):
            raise SettingError(
                f"rerun's viewer stopped: {last_line(viewer.collect_errors())}. "
                "Try: dmrl view --save"
            )
        direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        files = {}
        for name in PAGE_FILES:
            with direct.open(f"http://{LOOPBACK}:{port}/{name}", timeout=60) as answer:
                files[name] = answer.read()
    files[""] = re.sub(rb"<link[^>]*https?://[^>]*>", b"", files[""])
    return files


class _Handler(BaseHTTPRequestHandler):
    """Answers one connection."""

    protocol_version = "HTTP/1.1"
    timeout = CLIENT_TIMEOUT_S

    def __init__(
        self,
        root: str,
        hosts: frozenset[str],
        files: Mapping[str, bytes],
        data: DataFile,
        *connection: object,
    ) -> None:
        self._root, self._hosts, self._files, self._data = root, hosts, files, data
        super().__init__(*connection)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        """Answer with a file of the page, or with the data."""
        if not _is_allowed(self.headers.get("Host", ""), self._hosts):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        before, root, name = self.path.partition("?")[0].partition(self._root)
        if before or not root:
            self.send_error(HTTPStatus.NOT_FOUND)
        elif name == DATA_NAME:
            self._send_data()
        elif name in self._files:
            self._start(PAGE_FILES[name], {"Content-Length": str(len(self._files[name]))})
            self.wfile.write(self._files[name])
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send_data(self) -> None:
        self._start("application/octet-stream", {"Transfer-Encoding": "chunked"})
        with suppress(ConnectionError, ValueError):  # the client left, or the file is closed
            for block in self._data.iter_blocks():
                self.wfile.write(b"%x\r\n%b\r\n" % (len(block), block))
            self.wfile.write(b"0\r\n\r\n")

    def _start(self, kind: str, more: dict[str, str]) -> None:
        self.send_response(HTTPStatus.OK)
        for header, value in ({"Content-Type": kind} | HEADERS | more).items():
            self.send_header(header, value)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

    def version_string(self) -> str:
        """Return the Server header."""
        return "dmrl"
