"""The label desk in a browser: labels are moved, drawn, accepted, flagged and saved."""

import re
from pathlib import Path

import numpy as np
import pytest

import dmrl
from dmrl.cli import app
from dmrl.colours import RGB
from dmrl.errors import MissingTopic, SettingError

from .webdriver import MISSING, Browser, open_browser, wait_for

browser_only = pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")
pytestmark = [pytest.mark.heavy, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def desk_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with images, detections of a network, and a dataset."""
    place = tmp_path_factory.mktemp("desk")
    dmrl.sketch(place / "pictures", images=24, seed=4)
    dmrl.convert(place / "pictures", place / "flight.mcap")
    dmrl.predict("dmrl-nano", place / "flight.mcap", place / "seen.mcap")
    dmrl.make_dataset(place / "flight.mcap", place / "set", split="none")
    return place


def find_screen_position(browser: Browser, u_px: float, v_px: float) -> tuple[float, float]:
    """Return the position of an image pixel in the browser window, pixels."""
    script = f"""const at = new DOMPoint({u_px}, {v_px}).matrixTransform(
        document.querySelector('#stage svg').getScreenCTM()); return [at.x, at.y];"""
    return tuple(browser.run(script))


def read_label(browser: Browser, row: int, k: int) -> dict[str, float]:
    """Return label k of a row of the page."""
    return dict(browser.run(f"return rows[{row}].labels[{k}];"))


@browser_only
@pytest.mark.parametrize("width_px", [1200, 390])
@pytest.mark.parametrize("what", ["dataset", "recording"])
def test_edits_on_the_label_desk_reach_the_dataset(
    desk_folder: Path, tmp_path: Path, width_px: int, what: str
) -> None:
    given = ["set", "seen.mcap"] if what == "dataset" else ["seen.mcap"]
    page = tmp_path / "desk.html"
    words = ["view", *(str(desk_folder / name) for name in given), "--flag", str(page)]
    app(words, result_action="return_value")
    source = "flight.mcap" if what == "dataset" else "seen.mcap"
    truth = dmrl.open(desk_folder / "flight.mcap")["/cf1/labels"].to_arrow().to_pylist()
    with open_browser(tmp_path, width_px) as browser:
        browser.open(page)
        assert browser.run("return document.documentElement.scrollWidth <= innerWidth;")
        assert browser.run("return shown.length;") == 24
        # Marks have the colours of the other views, and a legend.
        marks = "label: truth", "label: hand", "detection of 0.52 or more", "less sure"
        legend = browser.run("return byId('legend').textContent;")
        assert [part.strip() for part in legend.split("\u00a0") if part.strip()] == list(marks)
        for mark, name in ((".label", "truth"), (".found", "detection")):
            colour = browser.run(
                f"return document.querySelector('#rows {mark}').getAttribute('stroke');"
            )
            assert colour == f"rgb{RGB[name]}"
        # A dataset is sorted by error, so rows are identified by their time.
        times = browser.run("return rows.map(row => row.time_ns);")
        row = next(k for k, t in enumerate(times) if len(find_truth(truth, t)) >= 1)
        # 1. Drag a label.
        browser.click(f"#row-{row}")
        assert re.search(r", suspicion \d+ %[,.]", browser.run("return byId('facts').textContent;"))
        first = read_label(browser, row, 0)
        browser.drag(
            find_screen_position(browser, first["u_px"], first["v_px"]),
            find_screen_position(browser, 200, 100),
        )
        moved = read_label(browser, row, 0)
        assert abs(moved["u_px"] - 200) < 1.5 and abs(moved["v_px"] - 100) < 1.5
        browser.screenshot(tmp_path / f"desk-{width_px}.png")
        # 2. Draw a label in the next image by the keyboard. 3. Flag the image after it.
        second, third = (
            browser.run(f"return shown[(shown.indexOf(rows[{row}]) + {k}) % 24].index;")
            for k in (1, 2)
        )
        for shown in (second, third):
            browser.press("\ue00c")
            browser.click(f"#row-{shown}")
            if shown == second:
                before = browser.run(f"return rows[{second}].labels.length;")
                browser.press("n")
                browser.drag(
                    find_screen_position(browser, 40, 60), find_screen_position(browser, 40, 60)
                )
                assert browser.run(f"return rows[{second}].labels.length;") == before + 1
            else:
                browser.click('[data-key="f"]')
        browser.press("\ue00c")
        browser.run("byId('save').click(); byId('flags').click();")
        corrections = tmp_path / f"corrections-{source.removesuffix('.mcap')}.mcap"
        wait_for(corrections)
        flags = wait_for(tmp_path / "flags.csv").decode().splitlines()
    assert flags == ["source,robot,log_time", f'"{source}","cf1","{times[third]}"']
    found = dmrl.open(corrections)
    errors = [f.text for f in found.check() if f.level == "error"]
    assert errors == ["labels without any image on /cf1/camera/image"]  # corrections have no images
    table = found["/cf1/labels"].to_arrow().to_pylist()
    assert sorted(one["log_time"] for one in table) == sorted(int(times[k]) for k in (row, second))
    assert {peer["source"] for one in table for peer in one["peers"]} == {"hand"}
    assert found.provenance is not None and found.provenance.inputs[0].name == source
    recording = desk_folder / source
    made = dmrl.make_dataset(
        recording,
        tmp_path / "fixed",
        split="none",
        corrections=[corrections],
        without=tmp_path / "flags.csv",
    )
    frame = made["train"].to_pandas()
    mine = frame[frame["log_time"] == int(times[row])]
    assert set(mine["label_source"]) == {"hand"}
    assert np.abs(mine[["u_px", "v_px"]].to_numpy() - [200, 100]).max(axis=1).min() < 1.5
    drawn = frame[frame["log_time"] == int(times[second])]
    assert len(drawn) == before + 1 and np.isinf(drawn["sigma_depth_m"]).sum() == 1
    assert int(times[third]) not in set(frame["log_time"]) and len(made["train"]) == 23


@browser_only
def test_pictures_that_were_never_labelled_become_a_dataset_on_the_desk(
    desk_folder: Path, tmp_path: Path
) -> None:
    pictures = tmp_path / "plain.mcap"
    dmrl.trim(desk_folder / "flight.mcap", pictures, topic=["/cf1/camera/*"])
    with pytest.raises(MissingTopic, match="by hand: dmrl view"):
        dmrl.make_dataset(pictures, tmp_path / "none")
    page = tmp_path / "desk.html"
    app(["view", str(pictures), "--flag", str(page)], result_action="return_value")
    with open_browser(tmp_path, 390) as browser:
        browser.open(page)
        browser.click("#row-3")
        browser.press("n")
        at = find_screen_position(browser, 40, 60)
        browser.drag(at, at)
        facts = browser.run("return byId('facts').textContent;")
        assert "no depth" in facts and "suspicion" not in facts
        browser.press("j")
        browser.press("e")
        assert "nobody in view" in browser.run("return byId('facts').textContent;")
        browser.press("j")
        browser.press("e")
        browser.press("z")  # undo the last step
        unsaved = "return !dispatchEvent(new Event('beforeunload', {cancelable: true}));"
        assert browser.run(unsaved)
        browser.press("\ue00c")
        browser.run("byId('save').click();")
        wait_for(tmp_path / "corrections-plain.mcap")
        assert not browser.run(unsaved)
    corrections = [tmp_path / "corrections-plain.mcap"]
    frame = dmrl.make_dataset(pictures, tmp_path / "mine", split="none", corrections=corrections)[
        "train"
    ].to_pandas()
    assert frame["row"].nunique() == 2
    assert frame["label_source"].dropna().tolist() == ["hand"]
    with pytest.raises(SettingError, match=r"corrects plain.mcap, which is not among"):
        dmrl.make_dataset(desk_folder / "flight.mcap", tmp_path / "other", corrections=corrections)


def find_truth(table: list[dict[str, object]], time_ns: str) -> list[object]:
    """Return the labels of an image that are not near its edges."""
    (one,) = (row for row in table if row["log_time"] == int(time_ns))
    peers = one["peers"]
    assert isinstance(peers, list)
    return [p for p in peers if 20 < p["u_px"] < 300 and 20 < p["v_px"] < 200]
