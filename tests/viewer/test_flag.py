"""Rows of a dataset marked on a page, saved as CSV, and left out of the next dataset."""

import csv
import json
from html.parser import HTMLParser
from pathlib import Path

import pytest

from dmrl.errors import SettingError
from dmrl.stages import dataset
from dmrl.stages.view import command
from dmrl.viewer import Settings, flag

from .test_web import Browser, Make, browser

__all__ = ["browser"]  # a fixture


class _Boxes(HTMLParser):
    """Values of the boxes, every tag, and every address."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.values: list[list[object]] = []
        self.tags: list[str] = []
        self.places: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        named = dict(attrs)
        self.places += [named[key] or "" for key in ("href", "src") if key in named]
        if tag == "input":
            self.values.append(json.loads(named["value"] or ""))


@pytest.fixture
def built(make: Make, tmp_path: Path) -> Path:
    settings = dataset.Settings(split="none", labels="truth")
    dataset.run([make()], tmp_path / "set", settings)
    return tmp_path / "set"


def test_every_row_has_a_box_that_names_it_and_nothing_is_fetched(
    built: Path, tmp_path: Path
) -> None:
    command([built], flag_to=tmp_path / "flag.html")
    seen = _Boxes((tmp_path / "flag.html").read_text())
    assert seen.values == [["flight.mcap", "cf1", k * 100_000_000] for k in range(9)]
    assert seen.tags.count("circle") == 9 and seen.tags.count("svg") == 9
    assert all(place.startswith("data:image/jpeg") for place in seen.places)


def test_what_the_page_names_is_left_out_and_provenance_says_so(
    built: Path, make: Make, tmp_path: Path
) -> None:
    flag([built], tmp_path / "flag.html", Settings())
    marked = _Boxes((tmp_path / "flag.html").read_text()).values[2:4]
    with (tmp_path / "flags.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([["source", "robot", "log_time"], *marked])
    settings = dataset.Settings(split="none", labels="truth", without=tmp_path / "flags.csv")
    made = dataset.run([tmp_path / "flight.mcap"], tmp_path / "clean", settings)
    assert made.images == {"train": 7} and made.tally.flagged == 2
    said = json.loads((tmp_path / "clean/provenance.json").read_text())
    assert [one["name"] for one in said["inputs"]] == ["flight.mcap", "flags.csv"]
    assert "2 images were flagged" in (tmp_path / "clean/README.md").read_text()


def test_names_of_recordings_cannot_become_markup(make: Make, tmp_path: Path) -> None:
    odd = make("a<img src=x onerror=alert(1)>.mcap")
    dataset.run([odd], tmp_path / "set", dataset.Settings(split="none", labels="truth"))
    flag([tmp_path / "set"], tmp_path / "flag.html", Settings())
    assert "img" not in _Boxes((tmp_path / "flag.html").read_text()).tags


def test_a_recording_alone_has_no_rows_to_flag(make: Make, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="is no dataset"):
        command([make()], flag_to=tmp_path / "flag.html")
    with pytest.raises(SettingError, match=r"--flag \.html"):
        command([make()], flag_to=tmp_path / "flag.csv")


@pytest.mark.slow
def test_a_browser_saves_what_was_clicked(built: Path, tmp_path: Path, browser: Browser) -> None:
    flag([built], tmp_path / "flag.html", Settings())
    browser.call("/url", {"url": (tmp_path / "flag.html").as_uri()})
    script = """
        const done = arguments[0], boxes = document.querySelectorAll('label');
        URL.createObjectURL = blob => { blob.text().then(done); return '#'; };
        boxes[1].click(); boxes[8].click(); boxes[1].click();
        document.querySelector('button').click();"""
    saved = browser.call("/execute/async", {"script": script, "args": []})
    assert saved == 'source,robot,log_time\n"flight.mcap","cf1","800000000"\n'
    count = {"script": "return document.querySelector('output').value", "args": []}
    assert browser.call("/execute/sync", count) == "1"
