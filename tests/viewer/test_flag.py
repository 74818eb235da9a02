"""Flagged rows of a dataset, saved as CSV, are omitted from the next dataset."""

import csv
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from dmrl.errors import SettingError
from dmrl.stages import dataset
from dmrl.stages.view import command
from dmrl.viewer import Settings
from dmrl.viewer.flag_page import write_flag_page
from dmrl.viewer.label_suspicion import score_suspicion

from .conftest import Make


class _Tags(HTMLParser):
    """Collects the tags and addresses of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.places: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        named = dict(attrs)
        self.places += [named[key] or "" for key in ("href", "src") if key in named]


def read_rows(page: Path) -> list[dict[str, Any]]:
    """Return the rows that a page holds."""
    (text,) = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', page.read_text()
    )
    return list(json.loads(text)["rows"])


def get_key(row: dict[str, Any]) -> list[Any]:
    """Return source, robot and time of a row, as in flags.csv."""
    return [row["source"], row["robot"], int(row["time_ns"])]


@pytest.fixture
def dataset_folder(make_recording: Make, tmp_path: Path) -> Path:
    """Return a dataset of ten images."""
    settings = dataset.Settings(split="none", labels="truth")
    dataset.run([make_recording()], tmp_path / "set", settings)
    return tmp_path / "set"


@pytest.mark.heavy
def test_every_row_names_its_image_and_nothing_is_fetched(
    dataset_folder: Path, tmp_path: Path
) -> None:
    command([dataset_folder], flag_to=tmp_path / "flag.html")
    rows = read_rows(tmp_path / "flag.html")
    assert [get_key(row) for row in rows] == [
        ["flight.mcap", "cf1", k * 100_000_000] for k in range(10)
    ]
    assert [len(row["labels"]) for row in rows] == [1] * 9 + [0]
    assert all(row["image"].startswith("data:image/jpeg") for row in rows)
    page = (tmp_path / "flag.html").read_text()
    assert _Tags(page).places == [] and "://" not in page.replace("http://www.w3.org", "")


def test_a_recording_is_shown_with_its_own_detections(make_recording: Make, tmp_path: Path) -> None:
    command([make_recording()], flag_to=tmp_path / "flag.html")
    rows = read_rows(tmp_path / "flag.html")
    assert len(rows) == 10
    assert [len(row["found"]) for row in rows] == [2] * 10
    assert [len(row["labels"]) for row in rows] == [2] * 9 + [0]


@pytest.mark.heavy
def test_flagged_rows_are_omitted_and_recorded_in_provenance(
    dataset_folder: Path, make_recording: Make, tmp_path: Path
) -> None:
    write_flag_page([dataset_folder], tmp_path / "flag.html", Settings())
    marked = [get_key(row) for row in read_rows(tmp_path / "flag.html")[2:4]]
    with (tmp_path / "flags.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([["source", "robot", "log_time"], *marked])
    settings = dataset.Settings(split="none", labels="truth", without=tmp_path / "flags.csv")
    made = dataset.run([tmp_path / "flight.mcap"], tmp_path / "clean", settings)
    assert made.images == {"train": 8} and made.tally.flagged == 2
    said = json.loads((tmp_path / "clean/provenance.json").read_text())
    assert [one["name"] for one in said["inputs"]] == ["flight.mcap", "flags.csv"]
    assert "images that were flagged (--without): 2" in (tmp_path / "clean/README.md").read_text()


@pytest.mark.heavy
def test_names_of_recordings_cannot_become_markup(make_recording: Make, tmp_path: Path) -> None:
    odd = make_recording("a<img src=x onerror=alert(1)>.mcap")
    dataset.run([odd], tmp_path / "set", dataset.Settings(split="none", labels="truth"))
    write_flag_page([tmp_path / "set"], tmp_path / "flag.html", Settings())
    assert "img" not in _Tags((tmp_path / "flag.html").read_text()).tags


def test_flag_page_needs_the_suffix_html(make_recording: Make, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"--flag \.html"):
        command([make_recording()], flag_to=tmp_path / "flag.csv")


@pytest.mark.parametrize("what", [["set", "flight.mcap"], ["flight.mcap"]])
@pytest.mark.heavy
def test_suspicion_uses_faint_peaks_of_the_maps(
    what: list[str], dataset_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known: list[Any] = []

    def score(images: list[Any], size_px: Any) -> Any:
        known.extend(images)
        return score_suspicion(images, size_px)

    monkeypatch.setattr("dmrl.viewer.flag_page.score_suspicion", score)
    write_flag_page([tmp_path / name for name in what], tmp_path / "flag.html", Settings())
    assert len(known) == 10
    for _, found in known:
        sure, weak, faint = found
        assert (sure["confidence"], weak["confidence"]) == (0.9, 0.1)
        assert faint == pytest.approx({"u_px": 36, "v_px": 36, "depth_m": 1.8, "confidence": 0.06})
    shown = [one for row in read_rows(tmp_path / "flag.html") for one in row["found"]]
    assert len(shown) == 20
