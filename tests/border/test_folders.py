"""Folders of strangers: what would be read without end is refused before it is opened."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dmrl.border.folders import refuse_pipes
from dmrl.datasets import open_dataset
from dmrl.deploy import store
from dmrl.deploy.detector import open_detector
from dmrl.errors import UnsafeName
from dmrl.formats.image_folder import list_pictures
from dmrl.learn.model import load_model
from dmrl.page import gather
from dmrl.rendering.backdrops import photos_in
from dmrl.stages import calibrate, convert
from dmrl.storage import path_of

OPENED: dict[str, Callable[[Path], object]] = {
    "a dataset": open_dataset,
    "a model": load_model,
    "an int8 model": store.load,
    "a model for a backend": lambda path: open_detector(path, "onnx"),
    "pictures": lambda path: list_pictures(path, 10.0),
    "backgrounds": photos_in,
    "outputs": gather,
    "logs": lambda path: convert.run(path, path.with_name("a.mcap"), convert.Settings()),
    "boards": lambda path: calibrate.run(
        [path], path.with_name("a.toml"), calibrate.Settings("7x5")
    ),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
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


def test_what_is_no_folder_here_is_left_to_who_opens_it(folder: Path) -> None:
    refuse_pipes(folder / "a.txt")
    refuse_pipes(folder / "absent")
    refuse_pipes(path_of("s3://bucket/key"))
