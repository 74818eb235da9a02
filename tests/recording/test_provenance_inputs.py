"""Inputs recorded in the provenance of an output."""

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import pytest

from dmrl.errors import RecordingError
from dmrl.recording import Provenance, RecordingWriter, build_provenance
from dmrl.recording.provenance import FILE_NAME
from dmrl.recording.provenance_inputs import build_input, hash_folder, refuse_duplicates


def write_folder(path: Path, **files: str) -> Path:
    """Write text files; in names, ``__`` stands for ``/`` and ``_md`` for ``.md``."""
    for name, text in files.items():
        file = path / name.replace("__", "/").replace("_md", ".md")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return path


def test_folder_hash_depends_on_names_and_contents(tmp_path: Path) -> None:
    here = write_folder(tmp_path / "a", one="1", sub__two="2", README_md="card", figures__plot="x")
    same = write_folder(tmp_path / "b", figures__plot="x", README_md="card", sub__two="2", one="1")
    assert hash_folder(here) == hash_folder(same)
    known = {hash_folder(here)}
    for change in ({"one": "2"}, {"three": ""}, {"README_md": "other"}, {"figures__plot": "y"}):
        write_folder(here, **change)
        known.add(hash_folder(here))
    assert len(known) == 5  # without dmrl's provenance.json, cards and figures count too


def test_folder_hash_ignores_its_card_and_figures(tmp_path: Path) -> None:
    here = write_folder(tmp_path / "a", one="1", README_md="card", sub__README_md="text")
    (here / FILE_NAME).write_text("{}")
    before = hash_folder(here)
    write_folder(here, README_md="written again", figures__plot="x", tensorboard__log="y")
    assert hash_folder(here) == before
    write_folder(here, sub__README_md="other")
    assert hash_folder(here) != before


def test_input_has_name_hash_and_provenance(tmp_path: Path) -> None:
    made = Provenance("test", {"level": 1})
    with RecordingWriter(tmp_path / "a.mcap", made):
        pass
    found = build_input(tmp_path / "a.mcap")
    assert (found.name, found.provenance) == ("a.mcap", made)
    assert found.sha256 == sha256((tmp_path / "a.mcap").read_bytes()).hexdigest()
    assert build_input(write_folder(tmp_path / "b", one="1")).provenance is None
    with pytest.raises(RecordingError, match="no file or folder"):
        build_input(tmp_path / "none")


@dataclass
class Settings:
    level: int
    camera: Path


def test_settings_hold_file_names_without_their_folders() -> None:
    made = build_provenance(
        "test", Settings(2, Path("/somewhere/camera.toml")), seed=4, libraries=("no",)
    )
    assert made.settings == {"level": 2, "camera": "camera.toml"}
    assert (made.seed, made.libraries, made.inputs) == (4, {"no": "absent"}, ())
    assert build_provenance("test", {"a": 1}).settings == {"a": 1}
    assert build_provenance("test").settings == {}


def test_linked_recording_counts_as_a_duplicate(tmp_path: Path) -> None:
    one, link = tmp_path / "a.mcap", tmp_path / "b.mcap"
    one.touch()
    link.symlink_to(one)
    refuse_duplicates([one, tmp_path / "c.mcap"])
    with pytest.raises(RecordingError, match="given twice"):
        refuse_duplicates([one, link])
