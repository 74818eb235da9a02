"""Possible disk contents after a power failure, from the recorded calls of a command.

strace records what a command and its libraries write, sync, rename and remove.
`Recorded.survivors` yields the folder as it may be after a power loss at any moment. What was
synced is there. Each later write and name may be there or not, independently of the others.
"""

import os
import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

CALLS = (
    "openat,open,creat,write,pwrite64,writev,lseek,ftruncate,fsync,fdatasync,close,mkdir,mkdirat,"
    "rename,renameat,renameat2,link,linkat,unlink,unlinkat,rmdir,sendfile,copy_file_range,mmap,dup"
)
LINE = re.compile(r"^(\d+) +(\w+)\((.*)\) += (-?\d+|0x[0-9a-f]+)(<[^>]*>)?(?: .*)?$")
TEXT = re.compile(r'"((?:\\x[0-9a-f]{2})*)"')
NAMED = re.compile(r'(?:\w+<((?:\\x[0-9a-f]{2}|[^>\\])*)>, )?"((?:\\x[0-9a-f]{2})*)"')
HANDLE = re.compile(r"^(\d+)<([^>]*)>")


@dataclass
class Node:
    """A file with its writes, or a folder with its names; a moment is the number of a call."""

    is_folder: bool = False
    writes: list[tuple[int, int, bytes]] = field(default_factory=list)  # moment, offset, data
    cuts: list[tuple[int, int]] = field(default_factory=list)  # moment, size
    names: list[tuple[int, str, "Node | None"]] = field(default_factory=list)
    synced: list[int] = field(default_factory=list)

    def last_sync(self, moment: int) -> int:
        """Return the moment up to which it is on the disk, if the power fails at ``moment``."""
        return max((at for at in self.synced if at <= moment), default=-1)

    def data(self, moment: int) -> bytes:
        """Return the content of a file at a moment."""
        out = bytearray()
        changes = sorted([*self.writes, *((at, size, None) for at, size in self.cuts)])
        for at, place, data in ((c[0], c[1], c[2]) for c in changes):
            if at > moment:
                break
            if data is None:
                del out[place:]
                out += bytes(place - len(out))
            else:
                out += bytes(max(0, place - len(out)))
                out[place : place + len(data)] = data
        return bytes(out)

    def entries(self, moment: int) -> dict[str, "Node"]:
        """Return the names of a folder at a moment."""
        found: dict[str, Node] = {}
        for at, name, node in self.names:
            if at <= moment:
                found.pop(name, None)
                if node is not None:
                    found[name] = node
        return found


def unescape(text: str) -> str:
    """Return a name that strace prints in hexadecimal."""
    return os.fsdecode(bytes.fromhex(text.replace("\\x", ""))) if "\\x" in text else text


def join_threads(lines: Sequence[str]) -> Iterator[str]:
    """Yield whole calls: strace prints one in two parts where another thread comes between."""
    begun: dict[str, str] = {}
    for line in lines:
        process, _, call = line.partition(" ")
        if call.endswith("<unfinished ...>"):
            begun[process] = line.removesuffix("<unfinished ...>").rstrip()
        elif resumed := re.match(r" *<\.\.\. \w+ resumed>(.*)", call):
            yield begun.pop(process, "") + resumed[1]
        else:
            yield line


class Recorded:
    """The calls of a command below a folder.

    Parameters
    ----------
    folder
        The folder before the command; what is in it counts as synced.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.moment, self.moments = folder, 0, [0]
        self.root = self._read(folder)
        self._open: dict[int, tuple[Node, int]] = {}  # by descriptor: node, offset

    def _read(self, path: Path) -> Node:
        node = Node(path.is_dir(), synced=[0])
        if path.is_dir():
            node.names = [(0, inner.name, self._read(inner)) for inner in sorted(path.iterdir())]
        else:
            node.writes = [(0, 0, path.read_bytes())]
        return node

    def run(self, words: Sequence[str], log: Path, **options: object) -> None:
        """Run a command under strace, and record its calls.

        Raises
        ------
        AssertionError
            If it fails, or writes in a way that is not recorded.
        """
        strace = ["strace", "-f", "-y", "-xx", "-s", "100000000", "-e", f"trace={CALLS}"]
        done = subprocess.run(
            [*strace, "-o", str(log), *words],
            capture_output=True,
            text=True,
            check=False,
            **options,
        )  # type: ignore[call-overload]
        assert done.returncode == 0, done.stderr
        for line in join_threads(log.read_text(errors="replace").splitlines()):
            if (found := LINE.match(line)) and not found[4].startswith("-"):
                self._follow(found[2], found[3], found[4])

    def _find(self, path: str) -> tuple[Node, str] | None:
        """Return the folder of a path and its last part; None outside the folder."""
        place = Path(path)
        if not place.is_relative_to(self.folder) or place == self.folder:
            return None
        node = self.root
        *parents, name = place.relative_to(self.folder).parts
        for part in parents:
            node = node.entries(self.moment)[part]
        return node, name

    def _get(self, path: str) -> Node | None:
        if Path(path) == self.folder:
            return self.root
        found = self._find(path)
        return found[0].entries(self.moment).get(found[1]) if found else None

    def _set(self, path: str, node: Node | None) -> None:
        if found := self._find(path):
            found[0].names.append((self.moment, found[1], node))

    def _follow(self, call: str, given: str, result: str) -> None:
        self.moment += 1
        paths = [
            str(Path(unescape(folder or str(self.folder)), unescape(name)))
            for folder, name in NAMED.findall(given)
        ]
        handle = HANDLE.match(given)
        inside = handle and Path(unescape(handle[2])).is_relative_to(self.folder)
        held = self._open.get(int(handle[1])) if handle and inside else None
        if call in ("openat", "open", "creat") and paths:
            self._follow_open(call, given, paths[0], int(result))
        elif call in ("mkdir", "mkdirat"):
            self._set(paths[0], Node(is_folder=True))
        elif call in ("rename", "renameat", "renameat2", "link", "linkat"):
            node = self._get(paths[0])
            if node is not None:
                self._set(paths[1], node)
                if call.startswith("rename"):
                    self._set(paths[0], None)
            self.moments.append(self.moment)
        elif call in ("unlink", "unlinkat", "rmdir"):
            self._set(paths[0], None)
            self.moments.append(self.moment)
        elif handle and held and call != "dup":
            self._follow_handle(call, given, int(handle[1]), held, int(result, 0))

    def _follow_open(self, call: str, given: str, path: str, number: int) -> None:
        node = self._get(path)
        if node is None and self._find(path) and ("O_CREAT" in given or call == "creat"):
            node = Node()
            self._set(path, node)
        if node is not None:
            if "O_TRUNC" in given or call == "creat":
                node.cuts.append((self.moment, 0))
            self._open[number] = node, len(node.data(self.moment)) if "O_APPEND" in given else 0

    def _follow_handle(
        self, call: str, given: str, number: int, held: tuple[Node, int], result: int
    ) -> None:
        node, place = held
        if call in ("fsync", "fdatasync"):
            node.synced.append(self.moment)
            self.moments.append(self.moment)
        elif call == "close":
            del self._open[number]
        elif call == "lseek":
            self._open[number] = node, result
        elif call == "ftruncate":
            node.cuts.append((self.moment, int(given.split(", ")[1])))
        elif call in ("write", "pwrite64", "writev"):
            data = b"".join(bytes.fromhex(one.replace("\\x", "")) for one in TEXT.findall(given))
            at = int(given.rsplit(", ", 1)[1]) if call == "pwrite64" else place
            node.writes.append((self.moment, at, data[:result]))
            if call != "pwrite64":
                self._open[number] = node, at + result
        elif call == "sendfile":  # the source file is not changed meanwhile
            source, start = re.search(r", \d+<([^>]*)>, (?:\[(\d+)\]|NULL)", given).groups()  # type: ignore[union-attr]
            data = Path(unescape(source)).read_bytes()[int(start or place) :][:result]
            node.writes.append((self.moment, place, data))
            self._open[number] = node, place + result
        elif call == "mmap":
            assert "PROT_WRITE" not in given or "MAP_PRIVATE" in given, given
        else:
            raise AssertionError(f"{call} is not recorded: {given[:200]}")

    def survivors(self, into: Path) -> Iterator[tuple[str, Path]]:
        """Yield folders as they may be after a power loss at each sync, name and removal."""
        for moment in dict.fromkeys([*self.moments, self.moment]):
            for keeps_data in (False, True):
                for keeps_names in (False, True):
                    place = into / f"{moment}-{keeps_data:d}{keeps_names:d}"
                    self._write(self.root, place, moment, keeps_data, keeps_names)
                    yield f"{moment} of {self.moment}, {keeps_data=}, {keeps_names=}", place

    def _write(
        self, node: Node, path: Path, moment: int, keeps_data: bool, keeps_names: bool
    ) -> None:
        if node.is_folder:
            path.mkdir()
            known = node.entries(moment if keeps_names else node.last_sync(moment))
            for name, inner in known.items():
                self._write(inner, path / name, moment, keeps_data, keeps_names)
        else:
            path.write_bytes(node.data(moment if keeps_data else node.last_sync(moment)))
