"""Hostile bucket servers: endless listings, wrong bytes, uploads that are not stored."""

import hashlib
import os
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

import pytest

from dmrl.atomic_output import atomic_file, atomic_folder
from dmrl.errors import StorageError
from dmrl.guards import limits
from dmrl.storage import bucket, to_path
from dmrl.storage.system import get_filesystem

from ..faults.ending import run_to_end
from ..faults.inputs import Inputs, cli
from ..local_server import serve_locally

pytest.importorskip("s3fs")
pytestmark = [
    pytest.mark.filterwarnings("ignore"),  # from aiohttp, about broken connections
    pytest.mark.heavy,
]
ZEROS = bytes(1 << 20)
SENT_BYTES_MAX = 10_000_000
"""Most bytes that fit into the buffers of a socket after the client has stopped reading."""


@dataclass
class Store:
    """A bucket called lab: its objects, the fault ``wrong`` of its server, and counts of requests.

    Without ``wrong`` the server is valid.
    """

    objects: dict[str, bytes] = field(default_factory=dict)
    wrong: str = ""
    most_sent: int = 0
    pages: int = 0
    reads: int = 0
    inner_reads: int = 0


class Handler(BaseHTTPRequestHandler):
    """Answers the requests of s3fs, with the fault that ``store.wrong`` names."""

    store: Store
    protocol_version = "HTTP/1.1"

    def do_HEAD(self) -> None:
        """Send size and hash of an object, or that the bucket exists."""
        key = self._key()
        data = self.store.objects.get(key)
        if data is None:
            self._answer(404 if key else 200)
        else:
            self._answer(200, size=len(data), ETag=self._tag(data))

    def do_GET(self) -> None:
        """Send a page of the listing, or a range of an object."""
        address = urlsplit(self.path)
        if address.path.startswith("/secret"):
            self.store.inner_reads += 1
            self._answer(200, b"secret")
        elif "list-type=2" in address.query:
            self._list(parse_qs(address.query))
        else:
            self._read()

    def do_PUT(self) -> None:
        """Store an object, or as ``store.wrong`` asks only half, zeros, or nothing of it."""
        body = self.rfile.read(int(self.headers["Content-Length"] or 0))
        if self.headers.get("Content-Encoding") == "aws-chunked":  # the checksum follows the data
            size, _, rest = body.partition(b"\r\n")
            body = rest[: int(size.split(b";")[0], 16)]
        kept = {"half": body[: len(body) // 2], "other": bytes(len(body))}
        if self.store.wrong != "nothing":
            self.store.objects[self._key()] = kept.get(self.store.wrong, body)
        self._answer(200, ETag=self._tag(body))

    def do_POST(self) -> None:
        """Remove several objects."""
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        for key in re.findall("<Key>(.*?)</Key>", body):
            self.store.objects.pop(key, None)
        self._answer(200, b"<DeleteResult/>")

    def do_DELETE(self) -> None:
        """Remove an object."""
        self.store.objects.pop(self._key(), None)
        self._answer(204)

    def _key(self) -> str:
        return unquote(urlsplit(self.path).path).removeprefix("/lab").removeprefix("/")

    def _tag(self, data: bytes) -> str:
        return f'"{hashlib.md5(data).hexdigest()}"'

    def _read(self) -> None:
        store, data = self.store, self.store.objects.get(self._key())
        if data is None:
            self._answer(404, b"<Error><Code>NoSuchKey</Code></Error>")
            return
        store.reads += 1
        if store.wrong.startswith("leads "):
            self._answer(307, Location=store.wrong.removeprefix("leads "))
            return
        found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        assert found, "objects are read by ranges"
        first, last = int(found[1]), int(found[2])
        if store.wrong.startswith("replaced") and store.reads > 2:
            data = bytes(len(data))
            if store.wrong == "replaced" and self.headers.get("If-Match") != self._tag(data):
                self._answer(412, b"<Error><Code>PreconditionFailed</Code></Error>")
                return
        part, where = data[first : last + 1], f"bytes {first}-{last}/{len(data)}"
        tag = self._tag(data)
        match store.wrong:
            case "endless":
                self._answer(206, size=6_000_000_000, ETag=tag, Content_Range=where)
                self._send(part, ZEROS * 20)
            case "whole":
                self._answer(200, data, ETag=tag)
            case "fewer":
                self._answer(206, part[:-1], ETag=tag, Content_Range=where)
            case "elsewhere":
                where = f"bytes {first + 1}-{last + 1}/{len(data)}"
                self._answer(206, part, ETag=tag, Content_Range=where)
            case "drips":
                self._answer(206, size=len(part), ETag=tag, Content_Range=where)
                for k in range(20):
                    self._send(part[k : k + 1])
                    time.sleep(0.1)
            case _:
                self._answer(206, part, ETag=tag, Content_Range=where)

    def _list(self, asked: dict[str, list[str]]) -> None:
        store = self.store
        store.pages += 1
        prefix = asked.get("prefix", [""])[0]
        keys = sorted(key for key in store.objects if key.startswith(prefix))
        token = ""
        match store.wrong:
            case "more keys" | "the same keys":
                page = store.pages if store.wrong == "more keys" else 0
                keys = [f"{prefix}{page:09}-{k}" for k in range(100)]
                token = f"t{page}"
            case "no keys":
                keys, token = [], f"t{store.pages}"
            case "elsewhere":
                keys = ["other/a.mcap"]
            case "a page without end":
                self._answer(200, size=6_000_000_000)
                self._send(b"<ListBucketResult>" + b"<a>" * 10_000_000)
                return
            case "a page that drips":
                self._answer(200, size=1_000)
                for _ in range(20):
                    self._send(b"<")
                    time.sleep(0.1)
                return
        rows = "".join(
            f"<Contents><Key>{key}</Key><Size>1</Size><ETag>a</ETag></Contents>" for key in keys
        )
        more = f"<NextContinuationToken>{token}</NextContinuationToken>" if token else ""
        cut = str(bool(token)).lower()
        text = f"<ListBucketResult><IsTruncated>{cut}</IsTruncated>{rows}{more}</ListBucketResult>"
        self._answer(200, text.encode(), Content_Type="application/xml")

    def _answer(
        self, status: int, body: bytes = b"", size: int | None = None, **headers: str
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body) if size is None else size))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self._send(body)

    def _send(self, *parts: bytes) -> None:
        data, sent = b"".join(parts), 0
        try:
            while sent < len(data):
                sent += self.connection.send(data[sent : sent + len(ZEROS)])
        except OSError:
            self.close_connection = True
        self.store.most_sent = max(self.store.most_sent, sent)

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    return Inputs(tmp_path_factory.mktemp("inputs"))


@pytest.fixture
def store(inputs: Inputs, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    """Serve a recording as a.mcap in a bucket, and return the bucket."""
    store = Store({"a.mcap": inputs.dots.read_bytes()})
    handler = type("Mine", (Handler,), {"store": store})
    with serve_locally(handler) as port:
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "test")
        monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        get_filesystem.cache_clear()
        yield store
    get_filesystem.cache_clear()


def test_valid_bucket_server_is_read_and_written(
    store: Store, inputs: Inputs, tmp_path: Path
) -> None:
    """The faults below are refused by a server that otherwise works."""
    cli("trim", "s3://lab/a.mcap", "s3://lab/out/b.mcap", "--to-s", 0.9)
    shutil.copy(inputs.dots, tmp_path / "a.mcap")
    cli("trim", tmp_path / "a.mcap", tmp_path / "b.mcap", "--to-s", 0.9)
    assert store.objects["out/b.mcap"] == (tmp_path / "b.mcap").read_bytes()
    assert Path(os.fspath(to_path("s3://lab/a.mcap"))).read_bytes() == store.objects["a.mcap"]
    assert [str(one) for one in to_path("s3://lab/out").iterdir()] == ["s3://lab/out/b.mcap"]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("more keys", "lists more than 3000 objects"),
        ("the same keys", "lists more than 3000 objects"),
        ("no keys", "the server is too slow"),
        ("elsewhere", "cannot be a path"),
        ("a page without end", "sent other bytes than requested"),
        ("a page that drips", "the server is too slow"),
    ],
)
def test_endless_listing_is_stopped(
    wrong: str, said: str, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "LISTED_FILES", 3_000)
    monkeypatch.setattr(limits, "LISTING_S", 0.5)
    monkeypatch.setattr(limits, "ANSWER_BYTES", 100_000)
    monkeypatch.setattr(bucket, "PATIENCE_S", 0.5)
    monkeypatch.setattr(bucket, "SLOWEST_BPS", 1e6)
    store.wrong = wrong
    with pytest.raises(StorageError, match=said):
        to_path("s3://lab/set").list_files()  # type: ignore[attr-defined]
    status, text = run_to_end(lambda: cli("trim", "s3://lab/set", tmp_path / "out"))
    assert status == 1 and text.count("\n") <= 1 and not list(tmp_path.iterdir()), text
    assert store.most_sent < SENT_BYTES_MAX


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("endless", None),
        ("whole", "sent other bytes than requested"),
        ("fewer", "sent other bytes than requested"),
        ("elsewhere", "sent other bytes than requested"),
        ("replaced", "changed while it was read"),
        ("replaced, and If-Match ignored", "changed while it was read"),
        ("drips", "the server is too slow"),
        ("leads /secret", "s3://lab/a.mcap"),
    ],
)
def test_bucket_bytes_beyond_the_request_are_not_read(
    wrong: str, said: str | None, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bucket, "PATIENCE_S", 0.5 if wrong == "drips" else 30)
    store.wrong = wrong
    for command in ("info", "check"):
        store.reads = 0
        status, text = run_to_end(lambda c=command: cli(c, "s3://lab/a.mcap"))
        assert status == (0 if said is None else 1) and (said or "") in text, text
    assert store.most_sent < SENT_BYTES_MAX and not store.inner_reads


def test_a_copy_of_an_object_that_is_replaced_is_refused(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmrl.storage.remote_stream.WHOLE_FILE_STEP_BYTES", 500)
    store.wrong = "replaced"
    store.objects["a.mcap"] += bytes(2_000)  # differs from the copies that were read before
    with pytest.raises(StorageError, match="changed while it was read"):
        os.fspath(to_path("s3://lab/a.mcap"))


@pytest.mark.parametrize("wrong", ["half", "other", "nothing"])
def test_an_upload_that_is_not_stored_is_an_error(wrong: str, store: Store) -> None:
    store.wrong = wrong
    file, folder = to_path("s3://lab/new.bin"), to_path("s3://lab/new")
    with pytest.raises(StorageError, match="not store what it was"), atomic_file(file) as here:
        here.write_bytes(b"a flight")
    with pytest.raises(StorageError), atomic_folder(folder) as here:
        (here / "b").write_bytes(b"a dataset")
    assert list(store.objects) == ["a.mcap"]
    status, output = run_to_end(lambda: cli("trim", "s3://lab/a.mcap", "s3://lab/b.mcap"))
    assert status == 1 and "s3://lab/b.mcap: the server does not store" in output, output


@pytest.mark.parametrize("key", ["t\x1b[2J.mcap", "a\rb.mcap", "a\x7f/b.mcap", "\u202egnp.mcap"])
def test_key_with_control_characters_is_refused(
    key: str, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = to_path("s3://lab/set")
    names = [f"lab/set/{key}", "lab/set/good.mcap"]
    monkeypatch.setattr(get_filesystem("s3"), "find", lambda _: names)
    with pytest.raises(StorageError, match="cannot be a path"):
        list(folder.iterdir())
    status, output = run_to_end(lambda: cli("trim", folder, tmp_path / "out"))
    assert status == 1 and output.isprintable() and not list(tmp_path.iterdir()), output
