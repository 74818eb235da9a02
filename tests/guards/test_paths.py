"""Untrusted folders: pipes and devices are refused before they are opened."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from dmrl import cli, recipe
from dmrl.datasets import open_dataset
from dmrl.deploy.detector import open_detector
from dmrl.deploy.int8 import store
from dmrl.errors import UnsafeName
from dmrl.formats.files.image_folder import list_images
from dmrl.geometry.camera_file import read_camera
from dmrl.guards.paths import refuse_pipe, refuse_pipes, require_text_path
from dmrl.html_report import collect_outputs
from dmrl.learn.inference.loaded_model import load_model
from dmrl.recording.provenance_inputs import build_input
from dmrl.rendering.backgrounds.photos import open_photos
from dmrl.stages import calibrate, convert
from dmrl.storage import to_path

OPENED: dict[str, Callable[[Path], object]] = {
    "a dataset": open_dataset,
    "a model": load_model,
    "an int8 model": store.load_network,
    "a model for a backend": lambda path: open_detector(path, "onnx"),
    "pictures": lambda path: list_images(path, 10.0),
    "backgrounds": open_photos,
    "outputs": collect_outputs,
    "logs": lambda path: convert.run(path, path.with_name("a.mcap"), convert.Settings()),
    "an input": lambda path: build_input(path / "a.png"),
    "boards": lambda path: calibrate.run(
        [path], path.with_name("a.toml"), calibrate.Settings("7x5")
    ),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a file and a subfolder."""
    (tmp_path / "given" / "deep").mkdir(parents=True)
    (tmp_path / "given" / "a.txt").write_text("a")
    return tmp_path / "given"


@pytest.mark.parametrize("what", OPENED)
def test_a_pipe_in_a_folder_is_refused_before_it_is_waited_for(what: str, folder: Path) -> None:
    for name in ("provenance.json", "a.png", "model.json", "a.csv"):
        os.mkfifo(folder / name)
    with pytest.raises(UnsafeName, match="is a pipe or a device"):
        OPENED[what](folder)


def test_pipes_and_links_to_devices_are_found_at_any_depth(folder: Path) -> None:
    refuse_pipes(folder)
    (folder / "nowhere").symlink_to("absent")
    (folder / "round").symlink_to(folder)
    refuse_pipes(folder)
    (folder / "deep" / "zero").symlink_to("/dev/zero")
    with pytest.raises(UnsafeName, match="deep/zero is a pipe"):
        refuse_pipes(folder)


def test_pipe_check_ignores_files_missing_paths_and_buckets(folder: Path) -> None:
    refuse_pipes(folder / "a.txt")
    refuse_pipes(folder / "absent")
    refuse_pipes(to_path("s3://bucket/key"))


@pytest.mark.parametrize(
    "reads",
    [
        to_path,
        recipe.read_text,
        lambda name: read_camera(Path(name)),
        lambda name: refuse_pipes(Path(name)),
    ],
    ids=["a command line", "a recipe", "a camera", "a folder"],
)
@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
def test_pipe_device_or_socket_is_refused(
    reads: Callable[[str], object], kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # socket names have a length limit
    if kind == "pipe":
        os.mkfifo("a.toml")
    elif kind == "device":
        Path("a.toml").symlink_to("/dev/zero")
    else:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind("a.toml")
    with pytest.raises(UnsafeName, match=r"^a.toml is a pipe or a device, not a file"):
        reads("a.toml")


@pytest.mark.heavy
def test_every_path_argument_refuses_pipes_and_devices() -> None:
    """Optional path arguments do so too."""
    of_paths = [
        (name, one.hint)
        for name in cli.COMMANDS
        for one in cli.app[name].assemble_argument_collection()
        if one.hint in (Path, Path | None)
    ]
    assert {name for name, hint in of_paths if hint != Path} >= {"label", "render", "train", "view"}
    for _, hint in of_paths:
        with pytest.raises(UnsafeName, match=r"^/dev/zero is a pipe or a device, not a file"):
            cli.convert_strictly(hint, ["/dev/zero"])


def test_path_may_be_file_folder_or_missing(tmp_path: Path) -> None:
    for name in (tmp_path, tmp_path / "absent", Path("x" * 5000)):
        refuse_pipe(name)
    with pytest.raises(UnsafeName, match=r"no file can be called 'a\\x00b'"):
        to_path("a\0b")


@pytest.mark.parametrize("name", [os.fsdecode(b"\xff"), os.fsdecode(b"\xff/b"), "a\0b"])
def test_non_utf_8_path_is_reported(name: str) -> None:
    require_text_path(Path("\N{LATIN SMALL LETTER E WITH ACUTE} \n\x1b"))
    with pytest.raises(UnsafeName, match=r"(Rename it|Check the name)$"):
        require_text_path(Path(name))


@pytest.mark.parametrize("what", ["a dataset", "a model", "a model for a backend"])
def test_paths_given_to_libraries_must_be_utf_8(what: str, tmp_path: Path) -> None:
    (given := tmp_path / os.fsdecode(b"\xff")).mkdir()
    with pytest.raises(UnsafeName, match="is not valid UTF-8"):
        OPENED[what](given)
