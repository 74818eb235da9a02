"""Hostile inputs to every command: nothing is written but OUT and temporary files.

Whatever the command says, the tree around it is the same before and after, and Python's own
trace of file accesses holds no write outside OUT.
"""

import hashlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dmrl import boundary
from dmrl.cli import COMMANDS, app
from dmrl.deploy.c import write_c
from dmrl.deploy.store import INTEGER_NAME, save
from dmrl.images.codec import encode_png
from dmrl.messages import message
from dmrl.recording import Channel, Provenance, RawMessage, RecordingWriter
from dmrl.recording.provenance import Input
from dmrl.recording.writer import channel_for

from .deploy.networks import random_network

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
    """The folders of a test: where OUT goes, what is around it."""

    root: Path

    def __getattr__(self, name: str) -> Path:
        return self.root / name


_watched: list[tuple[str, str]] | None = None


def _hook(event: str, args: tuple[Any, ...]) -> None:
    if _watched is None:
        return
    if event == "open" and isinstance(args[2], int) and args[2] & WRITES:
        _watched.append((event, os.fsdecode(args[0]) if not isinstance(args[0], int) else ""))
    elif event == "os.mkdir" and Path(os.fsdecode(args[0])).exists():
        pass  # asked for in case it is not there
    elif event in CHANGES and not (event in ("os.remove", "os.rmdir") and args[1] >= 0):
        # Names within an open folder, as of a folder that is removed, the tree tells of.
        _watched.extend((event, os.fsdecode(a)) for a in args[:2] if isinstance(a, str | bytes))


sys.addaudithook(_hook)


def _tree(root: Path) -> dict[str, str]:
    """Every file and folder outside OUT and the temporary folder, with its content."""
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
def _untouched(box: Box) -> Iterator[None]:
    """Nothing is written outside OUT and the temporary folder while the block lasts."""
    global _watched
    before = _tree(box.root)
    _watched = []
    try:
        yield
    finally:
        seen, _watched = _watched, None
    assert _tree(box.root) == before
    free = (box.out, box.temp, Path("/dev"), Path(sys.prefix), Path("/proc"))
    strange = [
        (event, path)
        for event, path in seen
        if path
        and not any((Path.cwd() / path).is_relative_to(one) for one in free)
        and "__pycache__" not in path
    ]
    assert strange == []


@pytest.fixture
def box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Box:
    """A folder to work in, a victim beside it, and OUT."""
    root = tmp_path.resolve()
    for name in ("cwd", "in", "out", "temp", "victim"):
        (root / name).mkdir()
    (root / "victim" / "keep").write_text("precious")
    monkeypatch.chdir(root / "cwd")
    monkeypatch.setattr(tempfile, "tempdir", str(root / "temp"))
    for name in ("TMPDIR", "HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(root / "temp"))
    monkeypatch.delenv("DMRL_DEBUG", raising=False)
    return Box(root)


def _run(box: Box, capsys: pytest.CaptureFixture[str], *words: object) -> int:
    """Exit status of a command that touches nothing; it is 0, or 1 with one line."""
    with _untouched(box):
        status = boundary.status_of(lambda: app([str(word) for word in words]))
    said = capsys.readouterr()
    assert "internal error" not in said.err, said.err
    assert "\x1b" not in said.out + said.err
    assert status in (0, 1), said.err
    last = said.err.strip().splitlines()[-1:]
    told = words[0] == "check" and not last  # what it found, on standard output
    assert status == 0 or told or last[0].startswith("dmrl: "), said.err
    return status


def _hostile(
    path: Path, split: dict[str, str] | None = None, robots: tuple[str, ...] = ROBOTS
) -> Path:
    """A recording of robots, peers, sources, metadata and inputs with hostile names."""
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
                picture = message("CompressedImage")(data=encode_png(rgb), format="../../x")
                peer = {"peer": PEERS[k], "u_px": 20, "v_px": 20, "depth_m": 1.0}
                peers = [{**peer, "source": source} for source in ("truth", "../../victim/keep")]
                found = [{"u_px": 20, "v_px": 20, "depth_m": 1.0, "confidence": 0.9}]
                for topic, one in (
                    ("camera/image", picture),
                    ("labels", message("PeerLabels")(peers=peers)),
                    ("detections", message("Detections")(detections=found)),
                    ("height", message("Height")(height_m=1.0)),
                    ("attitude", message("Attitude")()),
                    ("velocity", message("Velocity")()),
                    (f"range/{robot}", message("UwbRange")(range_m=1.0 + k)),
                ):
                    channel = channel_for(f"/{robot}/{topic}", one.DESCRIPTOR)
                    time_ns = k * 100_000_000
                    sink.write_raw(RawMessage(time_ns, time_ns, channel, one.SerializeToString()))
        height = message("Height")(height_m=2.0)
        for topic in (
            "/../../victim/keep",
            "/cf1.height",
            "../victim",
            "/",
            "",
            "/..",
            "cf1/height",
        ):
            like = channel_for("/cf1/height", height.DESCRIPTOR)
            channel = Channel(topic, like.schema_name, like.schema_data)
            sink.write_raw(RawMessage(0, 0, channel, height.SerializeToString()))
    return path


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
HOSTILE: dict[str, tuple[tuple[str, ...], ...]] = {
    "demo": (("--out", "IN/bad.mcap"), ("--out", "IN/link")),
    "run": (("IN/each.toml", "--out", "OUT/run"), ("IN/link.toml", "--out", "OUT/run")),
    "render": (("IN/each.toml", "OUT/render.mcap"), ("IN/link", "OUT/render.mcap")),
    "likeness": (("IN/pictures", "OUT/like.toml"), ("IN/bad.mcap", "OUT/like.toml")),
    "sketch": (("IN/link", "--images", "1"), ("OUT/sketch", "--images", "1")),
    "fly": (("IN/each.toml", "OUT/fly.mcap"),),
    "convert": (
        ("IN/bad.mcap", "OUT/csv", "--to", "csv"),
        ("IN/bad.mcap", "OUT/parquet", "--to", "parquet"),
        ("IN/bad.mcap", "OUT/ros", "--to", "ros2"),
        ("IN/logs", "OUT/logs.mcap", "--from", "csv"),
        ("IN/logs", "OUT/columns.mcap", "--columns", "IN/columns.toml"),
        ("IN/logs", "OUT/cfclient.mcap", "--from", "cfclient"),
        ("IN/pictures", "OUT/pictures.mcap", "--from", "images"),
        ("IN/link", "OUT/link.mcap"),
    ),
    "record": (("OUT/record.mcap", "--robot", "../../x=udp://127.0.0.1:1"),),
    "fake-drone": (("--flight", "IN/bad.mcap", "--uri", "udp://127.0.0.1:0x"),),
    "calibrate": (("IN/bad.mcap", "OUT/camera.toml"),),
    "align": (("IN/bad.mcap", "OUT/align.mcap"),),
    "label": (("IN/bad.mcap", "OUT/label.mcap"), ("IN/folder", "OUT/labels")),
    "dataset": (
        ("IN/bad.mcap", "OUT/set"),
        ("IN/bad.mcap", "OUT/sets", "--parquet"),
        ("IN/other.mcap", "OUT/cards", "--add"),
    ),
    "card": (("IN/bad.mcap",), ("OUT/cards",)),
    "train": (("OUT/cards", "OUT/run", "--epochs", "1"), ("IN/bad.mcap", "OUT/run")),
    "predict": (
        ("IN/model", "IN/bad.mcap", "OUT/predicted.mcap"),
        ("dmrl-nano", "IN/bad.mcap", "OUT/nano.mcap"),
    ),
    "track": (("IN/bad.mcap", "OUT/track.mcap"),),
    "evaluate": (("IN/bad.mcap",), ("IN/bad.mcap", "--plots", "OUT/judged")),
    "quantize": (("IN/model", "OUT/cards", "OUT/int8"), ("dmrl-nano", "OUT/cards", "OUT/int8")),
    "export": (("IN/model", "OUT/exported"), ("IN/link", "OUT/exported")),
    "verify": (("IN/model",), ("IN/link",)),
    "view": (("IN/bad.mcap", "--save", "OUT/view.rrd"),),
    "doctor": ((),),
    "report": (("IN", "OUT/page.html"), ("OUT/cards",)),
    "info": (("IN/bad.mcap",), ("IN/bad.mcap", "--json"), ("IN/link",)),
    "check": (("IN/bad.mcap",), ("IN/bad.mcap", "--json"), ("IN/link",)),
    "index": (("OUT/found",), ("IN/link",)),
    "find": (("true", "OUT/found"), ("true", "IN/link"), ("true", "IN")),
    "recover": (("IN/bad.mcap", "OUT/recovered.mcap"), ("IN/link", "OUT/recovered2.mcap")),
    "merge": (("IN/bad.mcap", "IN/other.mcap", "OUT/merged.mcap"),),
    "trim": (
        ("IN/bad.mcap", "OUT/trimmed.mcap"),
        ("IN/link", "OUT/trimmed2.mcap"),
        ("IN/folder", "OUT/job", "--on", "slurm"),
    ),
}
"""What every command is given: inputs full of hostile names, links to what is not theirs."""


@pytest.fixture(scope="module", params=[ROBOTS, CONTROLS], ids=["names", "controls"])
def inputs(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of everything a stranger can give, and a dataset made of it."""
    root = tmp_path_factory.mktemp("hostile")
    bad = _hostile(root / "bad.mcap", robots=request.param)
    _hostile(root / "other.mcap", {"x": "[[0, 1]]"}, request.param)
    (root / "each.toml").write_text(EACH)
    (root / "columns.toml").write_text(COLUMNS)
    for name in ("logs", "pictures", "folder", "model"):
        (root / name).mkdir()
    shutil.copy(bad, root / "folder" / "x\x1b[2J.mcap")
    for robot in ("..cf1", "$(touch victim)", "a\nb", "\x1b[2J", "<img src=x>"):
        log = "time_s,range_../../victim/keep_m\n0,1\n1,2\n"
        (root / "logs" / f"{robot}.csv").write_text(log)
        picture = encode_png(np.zeros((48, 64, 3), np.uint8))
        (root / "pictures" / f"{robot}.png").write_bytes(picture)
    layers = tuple(replace(layer, name=HOSTILE_TEXT) for layer in random_network(0).layers)
    save(
        replace(random_network(0), name=HOSTILE_TEXT, architecture=HOSTILE_TEXT, layers=layers),
        root / "model" / INTEGER_NAME,
    )
    named = bad if request.param is ROBOTS else _hostile(root / "named.mcap")
    made = ["dataset", str(named), str(root / "cards"), "--split", "recordings"]
    assert boundary.status_of(lambda: app(made)) == 0
    return root


def test_every_command_is_given_hostile_inputs() -> None:
    assert HOSTILE.keys() == COMMANDS.keys()


@pytest.mark.heavy
@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_writes_elsewhere_for_hostile_inputs(
    name: str, inputs: Path, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(inputs, box.root / "in", dirs_exist_ok=True)
    shutil.move(box.root / "in" / "cards", box.out / "cards")
    shutil.copytree(box.root / "in" / "folder", box.out / "found")
    shutil.copy(box.root / "in" / "bad.mcap", box.out / "found" / "bad.mcap")
    (box.root / "in" / "link").symlink_to(box.victim / "keep")
    (box.root / "in" / "link.toml").symlink_to(box.victim)
    for words in HOSTILE[name]:
        given = [
            w.replace("IN", str(box.root / "in")).replace("OUT", str(box.out))
            if w.startswith(("IN", "OUT"))
            else w
            for w in words
        ]
        _run(box, capsys, name, *given)
    pages = [
        p.read_text()
        for p in (box.out / "page.html", box.out / "cards" / "report.html")
        if p.is_file()
    ]
    assert not any("<img src=x" in page or "<script" in page for page in pages)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("words", "links"),
    [
        (("trim", "IN/bad.mcap", "OUT/x.mcap"), ("x.mcap", "x.mcap.partial")),
        (("recover", "IN/bad.mcap", "OUT/x.mcap"), ("x.mcap", "x.mcap.partial")),
        (("convert", "IN/bad.mcap", "OUT/x", "--to", "csv"), ("x", "x.partial")),
        (("dataset", "IN/bad.mcap", "OUT/x"), ("x", "x.partial")),
        (("sketch", "OUT/x", "--images", "1"), ("x", "x.partial")),
        (("fly", "fly_in_view", "OUT/x", "--duration-s", "1"), ("x", "x.partial")),
        (("export", "IN/model", "OUT/x"), ("x", "x.partial")),
        (("evaluate", "IN/bad.mcap", "--plots", "OUT/x"), ("x", "x.partial")),
        (("report", "OUT/cards"), ("cards/report.html", "cards/report.html.partial")),
        (("card", "OUT/cards"), ("cards/README.md.partial", "cards/figures/depth.png")),
        (("run", "IN/one.toml", "--out", "OUT/x"), ("x/recipe.toml.partial", "x/unfinished")),
        (("run", "IN/one.toml", "--out", "OUT/x"), ("x/pipeline.json.partial", "x/s.partial")),
        (("record", "OUT/x", "--robot", "cf1=udp://127.0.0.1:1"), ("x", "x.partial")),
        (("train", "OUT/cards", "OUT/x", "--epochs", "1"), ("x", "x.partial")),
    ],
    ids=lambda words: words[0],
)
@pytest.mark.parametrize("target", ["victim", "victim/keep"])
def test_links_in_out_are_not_written_through(
    words: tuple[str, ...], links: tuple[str, ...], target: str, inputs: Path, box: Box,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    shutil.copytree(inputs, box.root / "in", dirs_exist_ok=True)
    shutil.move(box.root / "in" / "cards", box.out / "cards")
    one = EACH.replace(
        '"../../victim/x", "/tmp/victim", "..", "a\\u001b[2J", "recipe.toml", "x"', '"s"'
    )
    (box.root / "in" / "one.toml").write_text(one)
    given = [w.replace("IN", str(box.root / "in")).replace("OUT", str(box.out)) for w in words]
    for link in links:
        path = box.out / link
        path.parent.mkdir(exist_ok=True)
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.symlink_to(box.root / target)
        if words[0] == "run":
            (path.parent / "pipeline.json").write_text('{"begun": {}, "done": {}, "hashes": {}}')
        _run(box, capsys, *given)
        if path.is_symlink():
            path.unlink()


@pytest.mark.heavy
@pytest.mark.usefixtures("empty_figures")
@pytest.mark.parametrize("split", ELSEWHERE)
def test_a_split_of_a_recording_stays_in_the_dataset(
    split: str, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    name = split.replace("{victim}", str(box.victim))
    bad = _hostile(box.root / "in" / "bad.mcap", {name: "[[0, 900000000]]"})
    for extra in ((), ("--parquet",)):
        for mode in ("auto", "recordings"):
            _run(
                box,
                capsys,
                "dataset",
                bad,
                box.out / f"{mode}{len(extra)}",
                "--split",
                mode,
                *extra,
            )
    assert not any("keep" in path.name for path in box.out.rglob("*"))


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.parametrize("split", ELSEWHERE)
def test_a_split_of_a_label_table_stays_in_the_dataset(
    split: str, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    name = split.replace("{victim}", str(box.victim))
    folder = box.root / "in" / "pictures"
    folder.mkdir()
    (folder / "000000000000.png").write_bytes(encode_png(np.zeros((48, 64, 3), np.uint8)))
    rows = f'file,peer,u_px,v_px,depth_m,split\n000000000000.png,cf2,3,4,1,"{name}"\n'
    (folder / "labels.csv").write_text(rows)
    out = box.out / "x.mcap"
    if _run(box, capsys, "convert", folder, out, "--from", "images") == 0:
        _run(box, capsys, "dataset", out, box.out / "set", "--split", "auto")


@pytest.mark.usefixtures("empty_figures")
def test_a_hostile_dataset_is_read_and_carded_where_it_is(
    box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = _hostile(box.root / "in" / "bad.mcap")
    good = box.out / "set"
    assert _run(box, capsys, "dataset", bad, good, "--split", "recordings") == 0
    card = (good / "README.md").read_text()
    assert "<img" not in card.replace("`", "")
    assert "\n# x" not in card
    for edit in (
        lambda d: (
            (d / "manifest.json").unlink(),
            (d / "dataset_dict.json").write_text('{"splits": ["../../victim"]}'),
        ),
        lambda d: (
            (d / "manifest.json").unlink(),
            (d / "dataset_dict.json").write_text('{"splits": [3, null]}'),
        ),
        lambda d: (d / "manifest.json").write_text(
            (d / "manifest.json").read_text().replace("data-", "../../../victim/data-")
        ),
        lambda d: (d / "manifest.json").write_text(
            (d / "manifest.json").read_text().replace('"train"', '"../../victim"')
        ),
        lambda d: (
            (d / "manifest.json").unlink(),
            (d / "train/state.json").write_text(
                json.dumps({"_data_files": [{"filename": "../../../victim/keep"}]})
            ),
        ),
        lambda d: (shutil.rmtree(d / "figures"), (d / "figures").symlink_to(box.victim)),
        lambda d: ((d / "README.md").unlink(), (d / "README.md").symlink_to(box.victim / "keep")),
        lambda d: (d / "provenance.json").write_text('{"stage": "*/", "inputs": [' * 2000),
        lambda d: (d / "provenance.json").write_text("[" * 100_000),
        lambda d: (d / "provenance.json").write_text('{"inputs": [], "settings": "x"}'),
    ):
        hurt = box.out / "hurt"
        shutil.copytree(good, hurt)
        (hurt / "figures").mkdir(exist_ok=True)
        edit(hurt)
        _run(box, capsys, "card", hurt)
        _run(box, capsys, "train", hurt, box.out / "run", "--epochs", "1", "--batch-size", "0")
        shutil.rmtree(hurt)


def test_a_model_s_names_do_not_become_code(box: Box, capsys: pytest.CaptureFixture[str]) -> None:
    network = random_network(0)
    layers = tuple(replace(layer, name=HOSTILE_TEXT) for layer in network.layers)
    bad = replace(network, name=HOSTILE_TEXT, architecture=HOSTILE_TEXT, layers=layers)
    folder = box.root / "in" / "model"
    folder.mkdir()
    save(bad, folder / INTEGER_NAME)
    for words in (
        ("export", folder, box.out / "exported"),
        ("verify", folder),
        ("predict", folder, folder, box.out / "x.mcap"),
        ("quantize", folder, folder, box.out / "q"),
    ):
        _run(box, capsys, *words)
    written = box.out / "c"
    written.mkdir()
    for name in write_c(bad, written, []):
        text = (written / name).read_text()
        assert "/etc/passwd" not in text
        assert "$(shell touch" not in text


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("width_px",), "1); system(0"),
        (("name",), 3),
        (("threshold",), float("nan")),
        (("threshold",), "0.5"),
        (("layers", 0, "stride"), "1 */"),
        (("layers", 0, "stride"), 0),
        (("layers", 0, "source"), 10**30),
        (("layers", 0, "scale"), float("inf")),
        (("heads", "confidence", "tensor"), 99),
        (("heads", "confidence", "channel"), "0"),
        (("layers",), 7),
        (("layers", 0), None),
        (("heads",), []),
    ],
)
def test_a_model_s_numbers_are_numbers(
    path: tuple[Any, ...], value: Any, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = box.root / "in" / "model"
    folder.mkdir()
    save(random_network(0), folder / INTEGER_NAME)
    with np.load(folder / INTEGER_NAME) as archive:
        arrays = {name: archive[name] for name in archive.files}
    said = json.loads(arrays.pop("description").tobytes())
    place = said
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    text = np.frombuffer(json.dumps(said).encode(), np.uint8)
    np.savez(folder / INTEGER_NAME, description=text, **arrays)
    assert _run(box, capsys, "export", folder, box.out / "x") == 1


# doctor reads none; index writes into the folder, and what cannot be read is a row of its own
@pytest.mark.heavy
@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ("doctor", "index")])
def test_every_command_takes_damaged_inputs_as_errors(
    name: str, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    deep = {
        "deep.json": "[" * 50_000,
        "deep.toml": f"kind = {'[' * 50_000}",
        "text.mcap": "not a recording",
        "table.toml": 'kind = "pipeline"\n[[step]]\nstage = "fly"\nout = "x"\nsettings = 3\n',
    }
    for file, text in deep.items():
        (box.root / "in" / file).write_text(text)
    pattern = {
        "run": ("run", "IN", "--out", "OUT"),
        "render": ("render", "IN", "OUT"),
        "fly": ("fly", "IN", "OUT"),
        "sketch": ("sketch", "IN", "--images", "1"),
        "demo": ("demo", "--out", "IN"),
        "convert": ("convert", "IN", "OUT", "--from", "images", "--camera", "IN"),
        "calibrate": ("calibrate", "IN", "OUT.toml"),
        "record": ("record", "OUT.mcap", "--robot", "../../x=udp://127.0.0.1:1"),
        "fake-drone": ("fake-drone", "--flight", "IN", "--uri", "udp://127.0.0.1:0x"),
        "train": ("train", "IN", "OUT"),
        "predict": ("predict", "IN", "IN", "OUT.mcap"),
        "quantize": ("quantize", "IN", "IN", "OUT"),
        "view": ("view", "IN", "--save", "OUT.rrd"),
        "report": ("report", "IN", "OUT.html"),
        "evaluate": ("evaluate", "IN"),
        "info": ("info", "IN"),
        "check": ("check", "IN"),
        "card": ("card", "IN"),
        "find": ("find", "true", "IN"),
        "verify": ("verify", "IN"),
    }.get(name, (name, "IN", "OUT.mcap"))
    for file in [*deep, "."]:
        given = str(box.root / "in" / file)
        words = [w.replace("IN", given).replace("OUT", str(box.out / "x")) for w in pattern]
        assert _run(box, capsys, *words) == 1
    assert list(box.out.iterdir()) == []


def _with_junk(path: Path, junk: str, calibration: dict[str, Any]) -> Path:
    """A recording in which the messages of one topic are not what their schema says."""
    made = message("CameraCalibration")(width=64, height=48, **calibration)
    picture = encode_png(np.full((48, 64, 3), 99, np.uint8))
    peers = [{"peer": "cf2", "u_px": 20, "v_px": 20, "depth_m": 1.0, "source": "truth"}]
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(6):
            for name, one in {
                "camera/calibration": made,
                "camera/image": message("CompressedImage")(data=picture, format="png"),
                "labels": message("PeerLabels")(peers=peers),
                "attitude": message("Attitude")(),
                "height": message("Height")(height_m=1.0),
                "velocity": message("Velocity")(),
                "detections": message("Detections")(),
            }.items():
                data = b"\xff\xff\xff\xff" if name == junk else one.SerializeToString()
                channel = channel_for(f"/cf1/{name}", one.DESCRIPTOR)
                sink.write_raw(RawMessage(k * 10**8, k * 10**8, channel, data))
    return path


@pytest.mark.heavy
@pytest.mark.usefixtures("empty_figures")
@pytest.mark.parametrize(
    ("junk", "calibration"),
    [
        ("camera/image", {}),
        ("labels", {}),
        ("attitude", {}),
        ("detections", {}),
        ("camera/calibration", {}),
        ("", {"K": [1.0, 2.0]}),
        ("", {"K": [float("nan")] * 9, "D": [float("inf")]}),
        ("", {"K": [0.0] * 9}),
    ],
)
def test_messages_that_cannot_be_read_are_one_line(
    junk: str, calibration: dict[str, Any], box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    bad, out = _with_junk(box.root / "in" / "bad.mcap", junk, calibration), box.out
    for words in (
        ("info", bad),
        ("check", bad),
        ("predict", "dmrl-nano", bad, out / "predicted.mcap"),
        ("track", bad, out / "track.mcap"),
        ("label", bad, out / "label.mcap"),
        ("align", bad, out / "align.mcap"),
        ("dataset", bad, out / "set"),
        ("convert", bad, out / "csv", "--to", "csv"),
        ("convert", bad, out / "ros", "--to", "ros2"),
        ("calibrate", bad, out / "camera.toml"),
        ("evaluate", bad),
        ("view", bad, "--save", out / "view.rrd"),
    ):
        _run(box, capsys, *words)


@pytest.mark.usefixtures("empty_figures")
def test_an_input_that_is_changed_meanwhile_is_one_line(
    box: Box, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _with_junk(box.root / "in" / "flight.mcap", "", {})
    other = _with_junk(box.root / "temp" / "other.mcap", "labels", {})

    def replace_it(*_: object) -> None:
        other.replace(path)

    monkeypatch.setattr("dmrl.datasets.parts.refuse_twins", replace_it)
    assert boundary.status_of(lambda: app(["dataset", str(path), str(box.out / "set")])) == 1
    said = capsys.readouterr().err
    assert "flight.mcap was changed while it was read. Run it again" in said
    assert list(box.out.iterdir()) == []


@pytest.mark.parametrize("name", ["../../victim/x", "{victim}/x", "recipe.toml", "..", "a/../../x"])
def test_a_recipe_s_step_writes_in_the_pipeline_s_folder(
    name: str, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    out = name.replace("{victim}", str(box.victim))
    recipe = box.root / "in" / "recipe.toml"
    step = f'[[step]]\nstage = "sketch"\nout = "{out}"\n[step.settings]\nimages = 1\n'
    recipe.write_text(f'kind = "pipeline"\n{step}')
    assert _run(box, capsys, "run", recipe, "--out", box.out / "a") == 1
    assert list(box.out.iterdir()) == []


def test_a_name_that_is_no_text_is_one_line(box: Box, capsys: pytest.CaptureFixture[str]) -> None:
    flight = _with_junk(box.root / "in" / os.fsdecode(b"\xff.mcap"), "", {})
    for words in (
        ("info", flight),
        ("check", flight),
        ("trim", flight, box.out / "trim.mcap"),
        ("merge", flight, box.out / "merge.mcap"),
        ("recover", flight, box.out / "recover.mcap"),
        ("label", flight, box.out / "label.mcap"),
        ("convert", flight, box.out / "csv", "--to", "csv"),
        ("convert", flight, box.out / "ros", "--to", "ros2"),
        ("evaluate", flight),
        ("view", flight, "--save", box.out / "view.rrd"),
        ("report", box.root / "in", box.out / "page.html"),
        ("dataset", flight, box.out / "set"),
    ):
        _run(box, capsys, *words)


def test_a_pipe_in_place_of_a_file_is_one_line(
    box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    """Opening it would wait for somebody who writes."""
    pipe, folder = box.root / "in" / "x.mcap", box.root / "in"
    for name in ("x.mcap", "x.h5", "model.json", "x.csv", "x.png", "labels.csv"):
        os.mkfifo(folder / name)
    for words in (
        ("info", pipe),
        ("recover", pipe, box.out / "recovered.mcap"),
        ("convert", pipe, box.out / "x.mcap"),
        ("convert", folder, box.out / "x.mcap"),
        ("convert", folder / "x.csv", box.out / "x.mcap"),
        ("convert", folder, box.out / "x.mcap", "--from", "images"),
        ("convert", folder, box.out / "x.mcap", "--from", "csv"),
        ("convert", folder, box.out / "x.mcap", "--from", "cfclient"),
        ("predict", folder / "x.h5", pipe, box.out / "x.mcap"),
        ("predict", folder, pipe, box.out / "x.mcap"),
        ("train", folder, box.out / "run"),
        ("report", folder, box.out / "page.html"),
    ):
        assert _run(box, capsys, *words) == 1
