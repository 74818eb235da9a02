"""The report of a folder shows its outputs, loads no other file, and tolerates invalid ones."""

import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dmrl
from dmrl.errors import OutputError, SettingError
from dmrl.html_report import build_report, collect_outputs, write_html_report
from dmrl.html_report.blocks import Table, Text
from dmrl.html_report.catalogue_tables import MAX_LISTED, _show_first
from dmrl.images.codec import encode_png
from dmrl.plots import charts
from dmrl.plots.image_figures import _place_texts

Evaluation = Callable[..., dict[str, Any]]


class _PageParser(HTMLParser):
    """Collects the tags, addresses and headings of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.places: list[str] = []
        self.headings: list[str] = []
        self._heading = False
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self._heading = tag == "h2"
        named = ("src", "href", "xlink:href", "action", "data")
        self.places += [value or "" for name, value in attrs if name in named]

    def handle_data(self, data: str) -> None:
        if self._heading:
            self.headings.append(data)
        self._heading = False


@pytest.mark.heavy
def test_report_shows_outputs_and_loads_nothing_external(outputs: Path) -> None:
    html = build_report(collect_outputs(outputs))
    seen = _PageParser(html)
    wanted = ["Detections", "Positions", "Training", "Images", "Recordings"]
    assert seen.headings == [*wanted, "Provenance"]
    assert not seen.tags & {"script", "link", "iframe", "object", "embed", "form"}
    assert all(place.startswith(("#", "data:image/")) for place in seen.places)
    assert "url(" not in re.sub(r"url\(#", "", html) and "@import" not in html
    assert "default-src 'none'" in html
    assert html.count("<svg") >= 6 and html.count("data:image/png") == 2
    assert "0.50 [0.45,\u00a00.55]" in html  # a line may break before the bracket only
    assert "24778" in html and "flight.mcap" in html
    assert "cf2 relative to cf1, from above; 95 % ellipses" in html
    assert "detection minus label" in html and ">0 to 1 m<" in html and "median error, px" in html


@pytest.mark.heavy
def test_report_of_images_has_card_figures_and_no_positions(
    tmp_path: Path,
) -> None:
    dmrl.sketch(tmp_path / "pictures", images=8, seed=1)
    dmrl.convert(tmp_path / "pictures", tmp_path / "pictures.mcap")
    dmrl.make_dataset(tmp_path / "pictures.mcap", tmp_path / "dataset")
    drawn = {path.stem for path in (tmp_path / "dataset/figures").glob("*.png")}
    assert drawn
    html = build_report(collect_outputs(tmp_path))
    assert all(f"dataset: {name}<" in html for name in {*drawn, "samples"})
    assert re.search(r">dataset</td><td[^>]*>train</td><td[^>]*>6</td>", html)
    assert "Positions" not in _PageParser(html).headings


@pytest.mark.heavy
def test_names_and_documents_cannot_become_markup(outputs: Path, evaluation: Evaluation) -> None:
    bad = "<script>alert(1)</script>"
    document = evaluation(against=bad, split=bad, recording={"name": bad, "sha256": ""})
    (outputs / "judged/evaluation.json").write_text(json.dumps(document))
    about = json.loads((outputs / "model/model.json").read_text())
    about["architecture"] = bad
    (outputs / "model/model.json").write_text(json.dumps(about))
    (outputs / "<img src=x>").mkdir()
    (outputs / "<img src=x>/evaluation.json").write_text(json.dumps(document))
    seen = _PageParser(build_report(collect_outputs(outputs)))
    assert "script" not in seen.tags and "x" not in seen.places


@pytest.mark.heavy
def test_invalid_documents_are_reported_and_the_rest_is_shown(
    outputs: Path, evaluation: Evaluation
) -> None:
    odd: list[Any] = [
        evaluation(recording=None),
        evaluation(bands=[{}]),
        evaluation(curves={"recall": "x"}),
        evaluation(overall=[1, 2]),
        evaluation(threshold="high"),
        {},
        [1],
        evaluation(threshold=10**400),
        evaluation(curves={"recall": [0.0, 0.5], "precision": [1.0]}),
        evaluation(curves={"recall": [[0.0]], "precision": [[[1.0]]]}),
        evaluation(curves={"bin_confidence": [0.1], "bin_right": [0.1, 0.2], "bin_count": [1]}),
    ]
    for k, document in enumerate(odd):
        (outputs / f"odd{k}").mkdir()
        (outputs / f"odd{k}/evaluation.json").write_text(json.dumps(document))
    html = build_report(collect_outputs(outputs))
    assert all(f"odd{k}" in html for k in range(len(odd)))
    assert "odd5 does not have dmrl's form" in html
    assert "evaluation.json is not a table" in html
    assert "Training" in html and "Recordings" in html


@pytest.mark.heavy
def test_unreadable_files_are_listed_and_the_rest_is_shown(outputs: Path) -> None:
    (outputs / "cut.mcap").write_bytes((outputs / "flight.mcap").read_bytes()[:-20])
    (outputs / "odd.png").write_bytes(b"\xff\xd8 no picture" * 30_000)
    html = build_report(collect_outputs(outputs))
    assert "cut.mcap" in html and "is cut short" in html and "Unreadable files" in html
    assert "odd.png" in html


@pytest.mark.heavy
def test_large_pictures_are_made_smaller_and_the_page_stays_small(outputs: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (900, 1600, 3), np.uint8)
    picture = encode_png(noise)
    for k in range(12):
        (outputs / f"large{k:02d}.png").write_bytes(picture)
    html = build_report(collect_outputs(outputs))
    assert len(html) < 10_000_000
    assert "data:image/jpeg" in html and "no room left in this page" in html


@pytest.mark.heavy
def test_a_report_is_written_again_but_no_other_file(outputs: Path) -> None:
    first = write_html_report(outputs)
    assert first == outputs / "report.html"
    before = first.read_bytes()
    assert write_html_report(outputs).read_bytes() == before
    other = outputs / "mine.html"
    other.write_text("<p>mine</p>")
    with pytest.raises(OutputError, match="is not a report of dmrl"):
        write_html_report(outputs, other)
    with pytest.raises(OutputError, match=r"Name it page\.html"):
        write_html_report(outputs, outputs / "page.pdf")
    with pytest.raises(OutputError, match=r"Name it page\.html"):
        write_html_report(outputs, Path())
    assert other.read_text() == "<p>mine</p>"


def test_report_of_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="contains no recording"):
        write_html_report(tmp_path)
    with pytest.raises(SettingError, match="is not a folder"):
        write_html_report(tmp_path / "none")


@pytest.mark.heavy
def test_log_axis_labels_are_plain_text_and_legend_is_outside() -> None:
    svg = charts.plot_losses({"one": [2.0, 0.5, 0.05], "two": [1.0, 0.1, 0.02]})
    assert "mathdefault" not in svg and ">0.1<" in svg and ">1<" in svg
    legend = svg.index('id="legend_1"')
    assert svg.rindex('id="axes_1"') < legend and svg.count('id="legend_') == 1


@pytest.mark.heavy
def test_distance_bands_are_in_order() -> None:
    near, far, rest = (0.0, 0.5), (0.5, 1.0), (1.0, np.inf)
    few = [(*far, 5.0, 4.0, 6.0), (*rest, 7.0, 6.0, 9.0)]
    all_of_them = [(*near, 3.0, 2.0, 4.0), *few]
    svg = charts.plot_by_distance({"few": few, "all": all_of_them}, "median error, px")
    assert re.findall(r">(0-0\.5|0\.5-1|1-)<", svg) == ["0-0.5", "0.5-1", "1-"]


def test_depth_texts_do_not_overlap_and_stay_in_the_image() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        uv_px = rng.uniform([0, 0], [320, 224], (2, 2))
        uv_px[1] = np.clip(uv_px[0] + rng.uniform(-30, 30, 2), 0, [320, 224])
        (u, v), (other_u, other_v) = _place_texts(uv_px, 320, 224)
        assert abs(u - other_u) >= 50 or abs(v - other_v) >= 14, uv_px
        assert 25 < u < 295 and 5 < v < 219


@pytest.mark.heavy
def test_the_pooled_figures_of_a_comparison_are_not_shown(
    evaluation: Evaluation, tmp_path: Path
) -> None:
    for common, shown in ((10, True), (5, False)):
        said = evaluation() | {"images": 10, "paired": {"images": common}}
        (tmp_path / "evaluation.json").write_text(json.dumps(said))
        html = build_report(collect_outputs(tmp_path))
        assert ("detection minus label" in html) == shown


def test_names_that_begin_with_a_digit_are_not_numeric_columns() -> None:
    rows = [["2026-11/f1.mcap", "0.5 (0.4, 0.6)", "12"], ["7.mcap", "-", "99.1% (98%, 100%)"]]
    assert Table(("recording", "error", "within"), rows).kinds == ["", "n", "n"]
    assert Table(("R2",), [["0.12 [-0.4, 0.6]"], ["< -1"]]).kinds == ["n"]


def test_a_catalogue_says_how_many_recordings_it_does_not_list() -> None:
    rows = [(f"f{k}.mcap", "cut short") for k in range(MAX_LISTED + 3)]
    table, more = _show_first("error", rows)
    assert isinstance(table, Table) and len(list(table.rows)) == MAX_LISTED
    assert isinstance(more, Text) and more.words.startswith("and 3 more")
