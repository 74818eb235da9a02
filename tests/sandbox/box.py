"""Watch a folder for writes outside OUT, and write hostile inputs for the commands."""

import hashlib
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dmrl import boundary
from dmrl.cli import app
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.store import INTEGER_NAME, save_network
from dmrl.deploy.samples import save_samples
from dmrl.images.codec import encode_png
from dmrl.learn.pretrained import resolve_model_path
from dmrl.messages import message_class
from dmrl.recording import Channel, Provenance, RawMessage, RecordingWriter
from dmrl.recording.provenance import Input
from dmrl.recording.writer import build_topic_channel

ROBOTS = ("cf1", "..", "a\\b", "$(touch victim)", "$x^{$y$", "`*/", "<img src=x>", "a.b")
CONTROLS = ("cf1", "x\x1b[2J", "n\nm", "\u202ecf2", "-rf")
PEERS = ("../../victim/keep", "/tmp/victim", "cf2", "|[x](y)|\n# z")
ELSEWHERE = ("../../victim/keep", "..", "a/b", "{victim}/keep", "data", "x\ny", "", "-rf")
HOSTILE_TEXT = (
    '*/\n#include "/etc/passwd"\nint main(void){return 7;}/*\\\n??/\n$(shell touch victim)'
)
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate")


CHANGES += ("os.chmod", "os.system", "os.posix_spawn", "os.exec")


class Box(NamedTuple):
    """The folders of a test, as attributes: cwd, in, out, temp and victim below ``root``."""

    root: Path

    def __getattr__(self, name: str) -> Path:
        return self.root / name


_watched: list[tuple[str, str]] | None = None


def _record_event(event: str, args: tuple[Any, ...]) -> None:
    """Record audit events that change files while a block is watched."""
    if _watched is None:
        return
    if event == "open" and isinstance(args[2], int) and args[2] & WRITES:
        _watched.append((event, os.fsdecode(args[0]) if not isinstance(args[0], int) else ""))
    elif event == "os.mkdir" and Path(os.fsdecode(args[0])).exists():
        pass  # the folder exists, so nothing is made
    elif event in CHANGES and not (event in ("os.remove", "os.rmdir") and args[1] >= 0):
        # Removals relative to an open folder have no full path; the hashed tree shows them.
        _watched.extend((event, os.fsdecode(a)) for a in args[:2] if isinstance(a, str | bytes))


sys.addaudithook(_record_event)


def _hash_tree(root: Path) -> dict[str, str]:
    """Return the hash of every file and folder outside OUT and the temporary folder, by path."""
    found = {}
    for folder, folders, files in os.walk(root):
        at = Path(folder)
        folders[:] = [f for f in folders if at / f not in (root / "out", root / "temp")]
        for name in [*folders, *files]:
            path = at / name
            content = path.read_bytes() if path.is_file() else b""
            found[str(path.relative_to(root))] = hashlib.sha256(content).hexdigest()
    return found


@contextmanager
def assert_untouched(box: Box) -> Iterator[None]:
    """Assert that the block writes nothing outside OUT and the temporary folder."""
    global _watched
    before = _hash_tree(box.root)
    _watched = []
    try:
        yield
    finally:
        seen, _watched = _watched, None
    assert _hash_tree(box.root) == before
    free = (box.out, box.temp, Path("/dev"), Path(sys.prefix), Path("/proc"))
    strange = [
        (event, path)
        for event, path in seen
        if path
        and not any((Path.cwd() / path).is_relative_to(one) for one in free)
        and "__pycache__" not in path
    ]
    assert strange == []


def run_command(box: Box, capsys: pytest.CaptureFixture[str], *words: object) -> int:
    """Run a command that must write nothing outside OUT; return its exit status.

    Assert that the status is 0, or 1 with a one-line error.
    """
    return run_and_capture(box, capsys, *words)[0]


def run_and_capture(
    box: Box, capsys: pytest.CaptureFixture[str], *words: object
) -> tuple[int, str]:
    """Run a command as `run_command` does; return its exit status and standard error."""
    with assert_untouched(box):
        status = boundary.run_to_status(lambda: app([str(word) for word in words]))
    output = capsys.readouterr()
    assert "internal error" not in output.err, output.err
    assert "\x1b" not in output.out + output.err
    assert status in (0, 1), output.err
    last = output.err.strip().splitlines()[-1:]
    told = words[0] == "check" and not last  # check prints its findings on standard output
    assert status == 0 or told or last[0].startswith("dmrl: "), output.err
    return status, output.err


def write_hostile_recording(
    path: Path, split: dict[str, str] | None = None, robots: tuple[str, ...] = ROBOTS
) -> Path:
    """Write a recording of robots, peers, sources, metadata and inputs with hostile names."""
    made = Provenance(
        "predict\n# x",
        {"recipe": "../../victim/keep", "x": "`*/"},
        inputs=(Input("../../victim/keep", "0" * 64), Input("a|b`c\n<b>", "x|y")),
        libraries={"numpy\n*/": "<script>"},
    )
    rng = np.random.default_rng(0)
    with RecordingWriter(path, made) as sink:
        if split is not None:
            sink.add_metadata("dmrl.split", split)
        sink.add_metadata("../../victim/keep", {"../x": "y"})
        sink.add_attachment("../../victim/keep", "text/plain", b"overwritten")
        for k in range(4):
            for robot in robots:
                rgb = rng.integers(0, 255, (48, 64, 3), np.uint8)
                picture = message_class("CompressedImage")(data=encode_png(rgb), format="../../x")
                peer = {"peer": PEERS[k], "u_px": 20, "v_px": 20, "depth_m": 1.0}
                peers = [{**peer, "source": source} for source in ("truth", "../../victim/keep")]
                found = [{"u_px": 20, "v_px": 20, "depth_m": 1.0, "confidence": 0.9}]
                for topic, one in (
                    ("camera/image", picture),
                    ("labels", message_class("PeerLabels")(peers=peers)),
                    ("detections", message_class("Detections")(detections=found)),
                    ("height", message_class("Height")(height_m=1.0)),
                    ("attitude", message_class("Attitude")()),
                    ("velocity", message_class("Velocity")()),
                    (f"range/{robot}", message_class("UwbRange")(range_m=1.0 + k)),
                ):
                    channel = build_topic_channel(f"/{robot}/{topic}", one.DESCRIPTOR)
                    time_ns = k * 100_000_000
                    sink.write_raw(RawMessage(time_ns, time_ns, channel, one.SerializeToString()))
        height = message_class("Height")(height_m=2.0)
        for topic in (
            "/../../victim/keep",
            "/cf1.height",
            "../victim",
            "/",
            "",
            "/..",
            "cf1/height",
        ):
            like = build_topic_channel("/cf1/height", height.DESCRIPTOR)
            channel = Channel(topic, like.schema_name, like.schema_data)
            sink.write_raw(RawMessage(0, 0, channel, height.SerializeToString()))
    return path


def write_quantized_model(folder: Path, network: IntegerNetwork) -> Path:
    """Write a model folder as ``dmrl quantize`` does: valid weights, and this int8 network."""
    shutil.copytree(resolve_model_path(Path("dmrl-nano")), folder)
    save_network(network, folder / INTEGER_NAME)
    save_samples(np.zeros((1, network.height_px, network.width_px, 3), np.uint8), folder)
    return folder


EACH = """kind = "pipeline"
[each]
name = ["../../victim/x", "/tmp/victim", "..", "a\\u001b[2J", "recipe.toml", "x"]
[[step]]
stage = "sketch"
out = "{name}"
images = 1
"""
COLUMNS = """[time]
name = "t"
unit = "s"
[range."../../victim/keep"]
name = "r"
unit = "m"
"""


def write_junk_messages(path: Path, junk: str, calibration: dict[str, Any]) -> Path:
    """Write a recording in which the messages of topic ``junk`` do not match their schema."""
    made = message_class("CameraCalibration")(width=64, height=48, **calibration)
    picture = encode_png(np.full((48, 64, 3), 99, np.uint8))
    peers = [{"peer": "cf2", "u_px": 20, "v_px": 20, "depth_m": 1.0, "source": "truth"}]
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(6):
            for name, one in {
                "camera/calibration": made,
                "camera/image": message_class("CompressedImage")(data=picture, format="png"),
                "labels": message_class("PeerLabels")(peers=peers),
                "attitude": message_class("Attitude")(),
                "height": message_class("Height")(height_m=1.0),
                "velocity": message_class("Velocity")(),
                "detections": message_class("Detections")(),
            }.items():
                data = b"\xff\xff\xff\xff" if name == junk else one.SerializeToString()
                channel = build_topic_channel(f"/cf1/{name}", one.DESCRIPTOR)
                sink.write_raw(RawMessage(k * 10**8, k * 10**8, channel, data))
    return path
