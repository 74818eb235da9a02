"""The card of a dataset: its front matter, counts, lineage, figures and warnings."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import dmrl
from dmrl.card import write_card
from dmrl.card.describe import describe_facts
from dmrl.card.facts import Facts
from dmrl.card.templating import fill_template
from dmrl.errors import DatasetError, SettingError
from dmrl.images.codec import encode_png
from dmrl.stages import convert
from dmrl.stages.card import Settings as CardSettings
from dmrl.stages.card import run as run_card
from dmrl.stages.dataset import Settings, run

from .conftest import Record, build_peer, make_recorder

huggingface_hub = pytest.importorskip("huggingface_hub")
yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
datasets = pytest.importorskip("datasets", reason="datasets is not installed")


@pytest.fixture(scope="module")
def dataset_with_figures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a dataset whose card has figures; tests must not change it."""
    folder = tmp_path_factory.mktemp("card")
    record = make_recorder(folder)
    flights = [
        record(peers=[[build_peer()], [], [build_peer(), build_peer(peer="cf3", u_px=40.0)]]),
        record("other.mcap", peers=[[build_peer(u_px=99.0)], [build_peer()]], seed=1),
    ]
    run(flights, folder / "out", Settings(title="Two flights: a test", license="cc-by-4.0"))
    return folder / "out"


@pytest.fixture
def dataset(dataset_with_figures: Path, tmp_path: Path) -> Path:
    """Return a copy of the dataset that the test may change."""
    return shutil.copytree(dataset_with_figures, tmp_path / "out")


def read_front_matter(folder: Path) -> Any:
    """Return the YAML front matter of a card."""
    return yaml.safe_load((folder / "README.md").read_text().split("---\n")[1])


@pytest.mark.heavy
def test_front_matter_has_the_fields_of_the_hub(dataset: Path) -> None:
    front = read_front_matter(dataset)
    assert front["pretty_name"] == "Two flights: a test"
    assert front["license"] == "cc-by-4.0"
    assert front["size_categories"] == ["n<1K"]
    info = front["dataset_info"]
    assert {s["name"]: s["num_examples"] for s in info["splits"]}.keys() == {"train", "test"}
    opened = datasets.load_from_disk(str(dataset))
    features = datasets.Features._from_yaml_list(info["features"])
    assert features == opened["train"].features


@pytest.mark.heavy
def test_card_counts_images_and_peers(dataset: Path) -> None:
    text = (dataset / "README.md").read_text()
    counts = re.findall(r"^\| (?:train|test) \| (\d+) \| (\d+) \| (\d+) \|", text, re.M)
    assert sorted(counts) == [("2", "1", "1"), ("3", "2", "3")]
    assert re.search(r"^\| flight.mcap \| (train|test) \| 3 \| 60.0 % \|$", text, re.M)


@pytest.mark.heavy
def test_every_column_has_a_meaning_with_its_unit(dataset: Path) -> None:
    text = (dataset / "README.md").read_text()
    rows = re.findall(r"^\| `([\w.]+)` \| [^|]+ \| ([^|]*) \|$", text, re.M)
    front = read_front_matter(dataset)["dataset_info"]["features"]
    names = [f["name"] for f in front] + [f"peers.{f['name']}" for f in front[1]["list"]]
    assert sorted(name for name, _ in rows) == sorted(names)
    assert all(meaning.strip() for _, meaning in rows)


def test_card_lists_the_lineage_with_hashes(dataset: Path) -> None:
    text = (dataset / "README.md").read_text()
    made = json.loads((dataset / "provenance.json").read_text())
    for source in made["inputs"]:
        assert f"input `{source['name']}`, SHA-256 `{source['sha256']}`" in text
    assert "    - **test**, dmrl" in text
    assert "seed = 1" in text


def test_card_includes_its_figures(dataset: Path) -> None:
    text = (dataset / "README.md").read_text()
    for name in ("depth.png", "position.png", "peers.png", "samples.jpg"):
        assert f"](figures/{name})" in text
        with Image.open(dataset / "figures" / name) as image:
            assert image.width >= 800


@pytest.mark.heavy
def test_writing_the_card_again_gives_the_same_bytes(dataset: Path) -> None:
    before = {p: p.read_bytes() for p in dataset.rglob("*") if p.is_file()}
    assert run_card(dataset, CardSettings()) == dataset / "README.md"
    assert {p: p.read_bytes() for p in dataset.rglob("*") if p.is_file()} == before


@pytest.mark.heavy
def test_card_can_be_written_to_another_folder(dataset: Path, tmp_path: Path) -> None:
    before = (dataset / "README.md").read_bytes()
    card = run_card(dataset, CardSettings(title="Elsewhere"), tmp_path / "card")
    assert card == tmp_path / "card" / "README.md"
    assert 'pretty_name: "Elsewhere"' in card.read_text(encoding="utf-8")
    assert (tmp_path / "card" / "figures" / "depth.png").is_file()
    assert (dataset / "README.md").read_bytes() == before


@pytest.mark.heavy
def test_card_warns_of_label_bias_exclusions_leaks_and_licence(
    record: Record, tmp_path: Path
) -> None:
    def build_boxed_peer(k: int) -> Any:
        u_px = 20.0 + k % 20
        box = [u_px - 8, 10, u_px + 8, 30]
        return build_peer(
            source="published", u_px=u_px, v_px=30.0, box_px=box, sigma_v_px=2.0 + k % 3
        )

    peers = [*([build_boxed_peer(k)] for k in range(30)), None]
    path = record(peers=peers, split={"train": "[[0, 10]]"})
    run([path], tmp_path / "out", Settings(split="none"))
    text = (tmp_path / "out" / "README.md").read_text()
    assert "labels from `published`: 30 of 30 have a sigma, median 0.0 px in u, 3.0 px in" in text
    assert "labels of source 'published' are biased: +0.0 px in u and +10.0 px in v" in text
    assert "- Left out: images that had no labels: 1." in text
    assert "- Leaks: no images of a test split" in text
    assert "- No licence was found" in text
    write_card(tmp_path / "out")
    assert (tmp_path / "out" / "README.md").read_text() == text


@pytest.mark.heavy
def test_image_in_train_and_test_is_reported_as_leak(record: Record, tmp_path: Path) -> None:
    path = record(split={"train": "[[0, 250000000]]", "test": "[[300000000, 600000000]]"}, seed=3)
    twin = record("twin.mcap", split={"test": "[[0, 600000000]]"}, seed=3)
    run([path, twin], tmp_path / "out", Settings())
    assert "- Leaks: 3 images of a test split have" in (tmp_path / "out" / "README.md").read_text()


@pytest.mark.heavy
def test_licences_beside_a_source_reach_the_card(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / "LICENSE.txt").write_text("\n# MIT License\n\nPermission is hereby granted\n")
    (folder / "0.png").write_bytes(encode_png(np.zeros((48, 64, 3), np.uint8)))
    (folder / "labels.csv").write_text("file,peer,u_px,v_px,depth_m\n0.png,cf2,10,20,0.5\n")
    convert.run(folder, tmp_path / "a.mcap", convert.Settings())
    run([tmp_path / "a.mcap"], tmp_path / "out", Settings())
    text = (tmp_path / "out" / "README.md").read_text()
    assert "- Licence of `pictures`: MIT License." in text


@pytest.mark.heavy
def test_handwritten_text_below_the_marker_is_kept(dataset: Path) -> None:
    readme = dataset / "README.md"
    before = readme.read_text(encoding="utf-8")
    readme.write_text(before + "\nFlown in hall 3.\n", encoding="utf-8")
    write_card(dataset, title="Hall 3")
    after = readme.read_text(encoding="utf-8")
    assert after.endswith("-->\n\nFlown in hall 3.\n") and 'pretty_name: "Hall 3"' in after
    write_card(dataset)
    assert readme.read_text(encoding="utf-8") == after


@pytest.mark.heavy
def test_title_and_license_can_be_given_and_stay(dataset: Path) -> None:
    run_card(dataset, CardSettings(title='A "new" name', license="mit"))
    readme = dataset / "README.md"
    readme.write_text(readme.read_text().replace('license: "mit"', "license: mit"))
    run_card(dataset, CardSettings())
    front = read_front_matter(dataset)
    assert (front["pretty_name"], front["license"]) == ('A "new" name', "mit")


@pytest.mark.heavy
def test_the_day_of_publication_stays_and_must_be_a_date(dataset: Path) -> None:
    run_card(dataset, CardSettings(published="2026-11-27"))
    run_card(dataset, CardSettings(title="Named"))
    about = json.loads((dataset / "croissant.json").read_text())
    assert (about["datePublished"], about["version"]) == ("2026-11-27", "1.0.0")
    assert "year = {2026}" in about["citeAs"] and "title = {Named}" in about["citeAs"]
    with pytest.raises(SettingError, match="--published soon is not a date"):
        run_card(dataset, CardSettings(published="soon"))


@pytest.mark.parametrize("license_id", ["cc0-1.0", "Apache-2.0 OR MIT", "odc-by", "other"])
@pytest.mark.heavy
def test_known_licences_are_accepted(dataset: Path, license_id: str) -> None:
    run_card(dataset, CardSettings(license=license_id))
    assert read_front_matter(dataset)["license"] == license_id


def test_unknown_licence_is_refused(dataset: Path, record: Record, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"--license foo-1: neither SPDX nor .* Try: cc-by-4"):
        run_card(dataset, CardSettings(license="foo-1"))
    with pytest.raises(SettingError, match="--license foo-1"):
        run([record("new.mcap", seed=2)], tmp_path / "new", Settings(license="foo-1"))
    assert not (tmp_path / "new").exists()


@pytest.mark.heavy
def test_figures_are_saved_with_the_matplotlib_backend_of_a_notebook(tmp_path: Path) -> None:
    code = (
        "import os, sys\nfrom pathlib import Path\nimport numpy as np\nfrom dmrl import plots\n"
        "plots.plot_error_violins(*np.ones((3, 9)), Path(sys.argv[1]))\n"
        "print(os.environ['MPLBACKEND'])"
    )
    inline = "module://matplotlib_inline.backend_inline"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "depth")],
        env={**os.environ, "MPLBACKEND": inline},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout.strip()) == (0, inline), done.stderr
    assert (tmp_path / "depth.png").is_file()


@pytest.mark.parametrize("options", [{}, {"png": True}, {"parquet": True}])
@pytest.mark.heavy
def test_python_examples_of_the_card_run(
    record: Record, tmp_path: Path, options: dict[str, bool]
) -> None:
    flight = record()
    run([flight], tmp_path / "out", Settings(split="none", **options))  # type: ignore[arg-type]  # bools
    text = (tmp_path / "out" / "README.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    assert len(blocks) == 3
    for code in blocks:
        names: dict[str, Any] = {}
        exec(code.replace("DATASET", str(tmp_path / "out")), names)
        shown = names["rgb"] if "rgb" in names else names["table"]
        assert shown.shape[0] in (48, 6)


def test_the_hub_reads_the_front_matter(dataset: Path) -> None:
    card = huggingface_hub.DatasetCard((dataset / "README.md").read_text())
    assert card.data.pretty_name == "Two flights: a test"
    assert (card.data.license, card.data.size_categories) == ("cc-by-4.0", ["n<1K"])
    assert card.data.task_categories == ["object-detection", "depth-estimation", "robotics"]
    huggingface_hub.DatasetCardData(**card.data.to_dict(), ignore_metadata_errors=False)
    infos = datasets.info.DatasetInfosDict.from_dataset_card_data(card.data)
    assert infos["default"].splits["train"].num_examples in (2, 3)
    assert infos["default"].features == datasets.load_from_disk(str(dataset))["train"].features


@pytest.mark.heavy
def test_card_lists_limitations_and_sensors(dataset: Path, tmp_path: Path) -> None:
    text = (dataset / "README.md").read_text()
    assert "- 2 of 5 images show no peer." in text and "peers in one image is 2." in text
    assert "- Labels by status: OK 5." in text
    assert "- No recording has a camera calibration." in text
    flight = dmrl.fly(tmp_path / "f.mcap", duration_s=4.0, camera=True, camera_rate_hz=1.0)
    run([flight.path], tmp_path / "set", Settings(split="none"))
    text = (tmp_path / "set" / "README.md").read_text()
    assert "from simulated flights. Those of a real camera differ" in text
    assert "`/{robot}/range/{peer}`" in text
    assert re.search(r"Camera of `f.mcap: cf1`, .*: 320 x 224 px, fx 183\.7", text)


def test_card_abbreviates_long_lists_of_recordings() -> None:
    names = [f"{k:03d}.mcap" for k in range(100)]
    cameras = {f"{name}: cf1": "320 x 224 px" for name in names} | {"other.mcap: cf1": "64 x 48 px"}
    facts = Facts(used=dict.fromkeys(names, "truth"), findings={n: ["a bias"] for n in names})
    values = describe_facts(replace(facts, cameras=cameras))
    lines = fill_template("sensors.md", **values).splitlines()
    assert lines[1:] == [
        "- Camera of `000.mcap: cf1`, `001.mcap: cf1`, `002.mcap: cf1` and 97 more: 320 x 224 px.",
        "- Camera of `other.mcap: cf1`: 64 x 48 px.",
    ]
    every = fill_template("facts.md", **values).splitlines()
    found = [line for line in every if "a bias" in line or "more lines" in line]
    assert len(found) == 21 and found[19] == "- `019.mcap`: a bias."
    assert found[20] == "- 80 more lines of this kind are in `facts.json`."


@pytest.mark.heavy
def test_a_dataset_without_any_peer_has_a_card(record: Record, tmp_path: Path) -> None:
    run([record(peers=[[], []])], tmp_path / "out", Settings(split="none"))
    assert "| train | 2 | 0 | 0 |" in (tmp_path / "out" / "README.md").read_text()


def test_a_folder_that_is_no_dataset_gets_no_card(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="is not a dataset"):
        write_card(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_broken_provenance_gives_one_line_error(dataset: Path) -> None:
    (dataset / "provenance.json").write_text("[]")
    with pytest.raises(DatasetError, match=r"provenance.json cannot be read .* again$"):
        write_card(dataset)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "[]",
        '{"left_out": "x"}',
        '{"left_out": {"x": "y"}}',
        '{"beside": {"a": ["b"]}}',
        '{"beside": {"a": 3}, "used": {"a": "b"}}',
        '{"licences": {"a": 3}}',
        '{"findings": {"a": [3]}}',
        '{"other": 1}',
    ],
)
def test_invalid_facts_give_one_line_error(dataset: Path, text: str) -> None:
    (dataset / "facts.json").write_text(text)
    with pytest.raises(DatasetError, match=r"facts.json cannot be read"):
        write_card(dataset)


@pytest.mark.heavy
def test_facts_are_escaped_in_the_card(dataset: Path) -> None:
    bad = "a`<img src=x>`b\n# heading"
    facts = {
        "left_out": {bad: 1},
        "used": {bad: bad},
        "beside": {bad: [bad]},
        "licences": {bad: bad},
    }
    (dataset / "facts.json").write_text(json.dumps(facts))
    text = write_card(dataset).read_text()
    assert "\n# heading" not in text
    assert re.search(r"(?<!\\)<img", re.sub(r"(`+)[^`].*?(?<!`)\1(?!`)", "", text)) is None


def test_card_that_is_not_utf_8_is_reported(dataset: Path) -> None:
    (dataset / "README.md").write_bytes(b"\xff\xfe")
    with pytest.raises(DatasetError, match="not UTF-8"):
        write_card(dataset)
