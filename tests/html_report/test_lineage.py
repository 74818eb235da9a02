"""The graph of a provenance: a box for each stage and round, and arrows from its inputs."""

import re

import numpy as np
import pytest

from dmrl.html_report.lineage import BOX_PX, build_lineage, draw_lineage
from dmrl.recording import Input, Provenance


def _make_provenance(stage: str, *inputs: Input) -> Provenance:
    """Return the provenance of an output."""
    return Provenance(stage, inputs=inputs)


def test_lineage_has_columns_with_counts_and_rounds() -> None:
    fly = [_make_provenance("fly"), _make_provenance("fly")]
    label = [_make_provenance("label", Input(f"f{k}", f"{k}", fly[k])) for k in range(2)]
    train = _make_provenance("train", Input("a", "10", label[0]), Input("b", "11", label[1]))
    again = _make_provenance("label", Input("f0", "0", fly[0]), Input("model", "20", train))
    made = dict(zip("abcdef", [*fly, *label, train, again], strict=True))
    columns, arrows = build_lineage(made)
    assert columns == [["fly x2"], ["label x2"], ["train"], ["label, round 2"]]
    assert set(arrows) == {
        ("fly x2", "label x2"),
        ("label x2", "train"),
        ("fly x2", "label, round 2"),
        ("train", "label, round 2"),
    }


def test_files_without_provenance_are_sources() -> None:
    columns, arrows = build_lineage({"a": _make_provenance("convert", Input("log.csv", "1"))})
    assert columns == [["file log.csv"], ["convert"]] and arrows == [("file log.csv", "convert")]
    many = _make_provenance("convert", *(Input(f"{k}.csv", f"{k}") for k in range(40)))
    columns, _ = build_lineage({"a": many})
    assert len(columns[0]) == 13 and columns[0][-1] == "more files"


def test_lineage_without_outputs_is_empty() -> None:
    assert build_lineage({}) == ([], [])


def _sample_path(path: str) -> np.ndarray:
    """Return (N, 2) points on an SVG path of lines and cubic curves, pixels."""
    numbers = [np.array(p.split(","), float) for p in re.findall(r"[-\d.]+,[-\d.]+", path)]
    found, share = [], np.linspace(0, 1, 41)[:, None]
    for a, b, c, d in zip(*(numbers[k::4] for k in range(4)), strict=True):
        if found:
            found.append(found[-1][-1] + share * (a - found[-1][-1]))
        one = 1 - share
        found.append(one**3 * a + 3 * one**2 * share * b + 3 * one * share**2 * c + share**3 * d)
    return np.concatenate(found)


@pytest.mark.heavy
def test_arrows_do_not_cross_boxes() -> None:
    rng = np.random.default_rng(0)
    for _ in range(30):
        made = {"0": _make_provenance("fly")}
        for k in range(1, 9):
            before = rng.choice(sorted(made), rng.integers(1, min(4, k) + 1), replace=False)
            stage = str(rng.choice(["label", "train", "predict", "track", "dataset", "merge"]))
            made[f"{k}"] = _make_provenance(
                stage, *(Input(n, n, made[n]) for n in map(str, before))
            )
        svg = draw_lineage(made)
        corners = np.array(re.findall(r'<rect x="([\d.]+)" y="([\d.]+)"', svg), float)
        paths = re.findall(r'<path d="(M[^"]+)" stroke', svg)
        assert len(corners) > 1 and paths
        for path in paths:
            inside = _sample_path(path)[:, None] - corners
            assert not ((inside > 0.1) & (inside < np.array(BOX_PX) - 0.1)).all(axis=-1).any()


def test_texts_of_boxes_are_escaped_and_cut() -> None:
    svg = draw_lineage({"a": _make_provenance("convert", Input("<b>" + "x" * 60 + ".csv", "1"))})
    assert "<b>" not in svg and "&lt;b&gt;" in svg and "x..." in svg
    assert draw_lineage({}) == ""
