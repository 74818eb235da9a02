"""Rows of a dataset marked on a page, saved as CSV, and left out of the next dataset."""

import csv
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

from dmrl.errors import SettingError
from dmrl.stages import dataset
from dmrl.stages.view import command
from dmrl.viewer import Settings
from dmrl.viewer.flag_page import write_flag_page

from .conftest import Make


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
    assert seen.values == [["flight.mcap", "cf1", k * 100_000_000] for k in range(10)]
    assert seen.tags.count("circle") == 9 and seen.tags.count("svg") == 10
    assert all(place.startswith("data:image/jpeg") for place in seen.places)


@pytest.mark.heavy
def test_what_the_page_names_is_left_out_and_provenance_says_so(
    built: Path, make: Make, tmp_path: Path
) -> None:
    write_flag_page([built], tmp_path / "flag.html", Settings())
    marked = _Boxes((tmp_path / "flag.html").read_text()).values[2:4]
    with (tmp_path / "flags.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([["source", "robot", "log_time"], *marked])
    settings = dataset.Settings(split="none", labels="truth", without=tmp_path / "flags.csv")
    made = dataset.run([tmp_path / "flight.mcap"], tmp_path / "clean", settings)
    assert made.images == {"train": 8} and made.tally.flagged == 2
    said = json.loads((tmp_path / "clean/provenance.json").read_text())
    assert [one["name"] for one in said["inputs"]] == ["flight.mcap", "flags.csv"]
    assert "2 images were flagged" in (tmp_path / "clean/README.md").read_text()


@pytest.mark.heavy
def test_names_of_recordings_cannot_become_markup(make: Make, tmp_path: Path) -> None:
    odd = make("a<img src=x onerror=alert(1)>.mcap")
    dataset.run([odd], tmp_path / "set", dataset.Settings(split="none", labels="truth"))
    write_flag_page([tmp_path / "set"], tmp_path / "flag.html", Settings())
    assert "img" not in _Boxes((tmp_path / "flag.html").read_text()).tags


def test_a_recording_alone_has_no_rows_to_flag(make: Make, tmp_path: Path) -> None:
    flight = make()
    with pytest.raises(SettingError, match="is no dataset"):
        command([flight], flag_to=tmp_path / "flag.html")
    with pytest.raises(SettingError, match=r"--flag \.html"):
        command([flight], flag_to=tmp_path / "flag.csv")


CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
CLICKS = """<script>
  const rows = document.querySelectorAll('label');
  URL.createObjectURL = blob => { blob.text().then(text => document.title = text); return '#'; };
  rows[1].click(); rows[8].click(); rows[1].click();
  document.querySelector('button').click();
</script></body>"""


def shown(page: Path) -> str:
    """What a browser makes of a page, after its scripts."""
    assert CHROMIUM is not None
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000")
    profile = f"--user-data-dir={page.parent / 'profile'}"
    command = [CHROMIUM, *flags, profile, "--dump-dom", page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=280).stdout


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no browser; apt-get install chromium")
def test_a_browser_runs_the_page_and_saves_what_was_clicked(built: Path, tmp_path: Path) -> None:
    page = tmp_path / "flag.html"
    write_flag_page([built], page, Settings())
    assert ">0</output>" in shown(page)  # its policy lets its own script run
    loose = re.sub(r"script-src '[^']*'", "script-src 'unsafe-inline'", page.read_text())
    page.write_text(loose.replace("</body>", CLICKS))
    done = shown(page)
    assert ">1</output>" in done
    saved = 'source,robot,log_time\n"flight.mcap","cf1","800000000"\n'
    assert f"<title>{saved}</title>" in done
