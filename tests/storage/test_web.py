"""Hostile web servers: only requested bytes of the requested file are read."""

import os
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest

from dmrl.errors import StorageError
from dmrl.recording import read_summary
from dmrl.storage import server_answers, to_path, web
from dmrl.storage.inner_addresses import is_inner
from dmrl.storage.system import get_filesystem

from ..faults.ending import ended
from ..faults.inputs import Inputs, cli
from ..local_server import serve_locally

pytest.importorskip("aiohttp")
pytestmark = pytest.mark.filterwarnings("ignore")  # of aiohttp and of broken connections
MOST_SENT = 10_000_000
"""What a server could send as one answer, into buffers of sockets, before nobody takes any more."""
ZEROS = bytes(1 << 20)


@dataclass
class Site:
    """A file on a web server, and what is wrong with the server."""

    data: bytes
    wrong: str = ""
    most_sent: int = 0
    asked: int = 0
    address: str = ""
    paths: list[str] = field(default_factory=list)

    @property
    def url(self) -> str:
        """Of the file."""
        return f"{self.address}/a.mcap"


class Handler(BaseHTTPRequestHandler):
    """Answers ranges, well or badly."""

    site: Site

    def setup(self) -> None:
        """Small buffers: what is not taken is soon not sent."""
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65_536)
        super().setup()

    def _lead(self) -> bool:
        """Lead elsewhere, from every page or from the first alone."""
        verb, _, words = self.site.wrong.partition(" ")
        where, _, once = words.partition(" ")
        leads = verb == "leads" and not (once and self.path == where)
        if leads:
            self._head(302, 0, {"Location": where})
        return leads

    def do_HEAD(self) -> None:
        """Its size."""
        if self._lead():
            return
        self.site.paths.append(self.path)
        if self.site.wrong == "lists" and "a.mcap" not in self.path:
            self._head(200, 0, {"Content-Type": "text/html"})
            return
        wrong = {"huge": 1 << 60, "none": None}
        self._head(200, wrong.get(self.site.wrong, len(self.site.data)))

    def do_GET(self) -> None:
        """A range, or the whole file."""
        site = self.site
        site.asked += 1
        if self._lead():
            return
        site.paths.append(self.path)
        asked = self.headers.get("Range")
        if site.wrong == "lists":
            self._list()
            return
        if asked is None or site.wrong == "whole":
            self._send_whole()
            return
        first, last = (int(n) for n in asked.removeprefix("bytes=").split("-"))
        part = site.data[first : last + 1]
        part += bytes(last + 1 - first - len(part)) if site.wrong == "huge" else b""
        more = {"Content-Range": f"bytes {first}-{last}/{len(site.data)}"}
        match site.wrong:
            case "endless":
                self._head(206, None, more)
                self._send(part, ZEROS * 20)
            case "more" | "fewer":
                part = part + ZEROS if site.wrong == "more" else part[:-1]
                self._head(206, len(part), more)
                self._send(part)
            case "elsewhere":
                part = (site.data[first + 1 :] + ZEROS)[: last + 1 - first]
                more["Content-Range"] = f"bytes {first + 1}-{last + 1}/{len(site.data)}"
                self._head(206, len(part), more)
                self._send(part)
            case "drips":
                self._head(206, len(part), more)
                for k in range(20):
                    self._send(part[k : k + 1])
                    time.sleep(0.1)
            case "packed":
                self._head(206, len(part), {**more, "Content-Encoding": "deflate"})
                self._send(part)
            case _:
                self._head(206, len(part), more)
                self._send(part)

    def _send_whole(self) -> None:
        site = self.site
        size = None if site.wrong in ("none", "endless", "short") else len(site.data)
        self._head(200, size)
        more = ZEROS * 20 if site.wrong == "endless" else b""
        self._send(site.data[: -9 if site.wrong == "short" else None], more)

    def _list(self) -> None:
        """A folder that holds a folder, without end."""
        text = b'<a href="b/">b/</a><a href="../../../victim">x</a>'
        self._head(200, len(text), {"Content-Type": "text/html"})
        self._send(text)

    def _head(self, status: int, size: int | None, more: dict[str, str] | None = None) -> None:
        self.send_response(status)
        if size is not None:
            self.send_header("Content-Length", str(size))
        changed = self.site.wrong == "changes" and self.site.asked > 1
        for name, value in {"ETag": '"b"' if changed else '"a"', **(more or {})}.items():
            self.send_header(name, value)
        self.end_headers()

    def _send(self, *parts: bytes) -> None:
        data, sent = b"".join(parts), 0
        try:
            while sent < len(data):
                sent += self.connection.send(data[sent : sent + len(ZEROS)])
        except OSError:
            self.close_connection = True
        self.site.most_sent = max(self.site.most_sent, sent)

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    return Inputs(tmp_path_factory.mktemp("inputs"))


@pytest.fixture
def site(inputs: Inputs) -> Iterator[Site]:
    """A recording on a server."""
    site = Site(inputs.dots.read_bytes())
    handler = type("Mine", (Handler,), {"site": site})
    with serve_locally(handler) as port:
        site.address = f"http://127.0.0.1:{port}"
        yield site
    get_filesystem.cache_clear()


def test_recording_on_a_web_server_equals_the_local_file(
    site: Site, inputs: Inputs, tmp_path: Path
) -> None:
    for name, source in (("here", inputs.dots), ("there", site.url)):
        out = tmp_path / f"{name}.mcap"
        cli("trim", source, out, "--to-s", 0.9)
    here, there = (read_summary(tmp_path / f"{name}.mcap") for name in ("here", "there"))
    assert here.count == there.count > 10 and here.topics == there.topics
    assert here.provenance and there.provenance
    assert here.provenance.inputs[0].sha256 == there.provenance.inputs[0].sha256


@pytest.mark.parametrize("wrong", [pytest.param("endless", marks=pytest.mark.heavy), "more"])
def test_server_bytes_beyond_the_request_are_not_read(wrong: str, site: Site) -> None:
    site.wrong = wrong
    for command in ("info", "check"):
        cli(command, site.url)
    assert site.asked > 10 and site.most_sent < MOST_SENT


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("fewer", "the server sent other bytes than requested"),
        ("elsewhere", "the server sent other bytes than requested"),
        ("packed", "the server sent other bytes than requested"),
        ("whole", "the server cannot send parts of a file"),
        ("changes", "changed while it was read"),
        ("none", "the server does not report its size"),
        ("huge", "is cut short"),
    ],
)
def test_wrong_server_answer_gives_one_line_error(wrong: str, said: str, site: Site) -> None:
    site.wrong = wrong
    for command in ("info", "check"):
        site.asked = 0
        status, text = ended(lambda c=command: cli(c, site.url))
        assert status == 1 and f"{site.url}" in text and said in text, text
    assert site.most_sent < MOST_SENT


def test_slow_server_is_abandoned(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_answers, "PATIENCE_S", 0.3)
    get_filesystem.cache_clear()
    web.WebFileSystem.clear_instance_cache()
    site.wrong = "drips"
    status, output = ended(lambda: cli("info", site.url))
    assert status == 1 and "the server is too slow" in output, output
    monkeypatch.undo()
    get_filesystem.cache_clear()
    web.WebFileSystem.clear_instance_cache()  # its session has that patience


@pytest.mark.parametrize("address", ["file:///etc/passwd", "s3://a/b", "http://127.0.0.1:1/a"])
def test_redirects_to_local_files_are_refused(address: str, site: Site) -> None:
    site.wrong = f"leads {address}"
    for command in ("info", "check"):
        status, output = ended(lambda c=command: cli(c, site.url))
        assert status == 1 and site.url in output, output
    with pytest.raises((StorageError, FileNotFoundError)):
        os.fspath(to_path(site.url))


def test_redirects_to_internal_addresses_are_refused(site: Site, inputs: Inputs) -> None:
    """Another server of this machine, by its number, by its name, and mapped to IPv6."""
    secret = Site(b"secret")
    handler = type("Inner", (Handler,), {"site": secret})
    with serve_locally(handler) as port:
        for host in ("127.0.0.1", "localhost", "[::ffff:127.0.0.1]", "0.0.0.0"):
            site.wrong = f"leads http://{host}:{port}/a.mcap"
            status, output = ended(lambda: cli("info", site.url))
            assert status == 1 and f"{site.url}: the server redirects to" in output, output
            with pytest.raises(StorageError, match="an inner address"):
                os.fspath(to_path(site.url))
    assert not secret.paths and not secret.asked


def test_redirects_within_a_server_are_followed(site: Site) -> None:
    site.wrong = "leads /b/a.mcap once"
    assert to_path(site.url).stat().st_size == len(site.data)
    assert Path(os.fspath(to_path(site.url))).read_bytes() == site.data


@pytest.mark.parametrize(
    ("address", "inner"),
    [
        ("127.0.0.1", True),
        ("10.1.2.3", True),
        ("192.168.0.1", True),
        ("169.254.169.254", True),
        ("0.0.0.0", True),
        ("::1", True),
        ("fe80::1%eth0", True),
        ("fd00::1", True),
        ("::ffff:10.0.0.1", True),
        ("93.184.216.34", False),
        ("2606:2800:220:1:248:1893:25c8:1946", False),
    ],
)
def test_addresses_of_machines_and_private_networks_are_inner(address: str, inner: bool) -> None:
    assert is_inner(address) is inner


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("", None),
        ("endless", None),
        ("huge", "bytes, but only"),
        ("short", None),  # only ranges are asked for
        ("changes", "changed while it was read"),
    ],
)
def test_local_copy_has_the_stated_size(wrong: str, said: str | None, site: Site) -> None:
    """As of a model, which a library opens by its name."""
    site.wrong = wrong
    if said is None:
        assert Path(os.fspath(to_path(site.url))).read_bytes() == site.data
        assert site.most_sent < MOST_SENT
        return
    site.asked = 1
    with pytest.raises(StorageError, match=said):
        os.fspath(to_path(site.url))


def test_a_folder_on_a_web_server_is_not_walked(site: Site, tmp_path: Path) -> None:
    site.wrong, out = "lists", tmp_path / "out"
    url = f"{site.address}/set"
    assert list(to_path(url).glob("*.mcap")) == list(to_path(url).iterdir()) == []
    for words in (("convert", url, out), ("check", url)):
        status, _ = ended(lambda w=words: cli(*w))
        assert status == 1 and not out.exists()
    assert len(site.paths) < 50
