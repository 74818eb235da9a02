"""Provenance with ancestors that several inputs share."""

import json
from pathlib import Path

import pytest

from dmrl.guards import limits
from dmrl.recording import Provenance
from dmrl.recording.overview import ancestry_lines
from dmrl.recording.provenance import Input


def build_rounds(count: int, flights: int) -> Provenance:
    """Return the provenance of a model that was trained for this many rounds.

    Each round trains on flights that the model of the round before labelled.
    """
    model = Provenance("train", {"round": 0})
    for k in range(1, count + 1):
        before = Input(f"model-{k - 1}", f"{k - 1:064d}", model)
        seen = (
            Input(f"seen-{n}.mcap", f"{k:032d}{n:032d}", Provenance("predict", {}, None, (before,)))
            for n in range(flights)
        )
        model = Provenance("train", {"round": k}, None, tuple(seen))
    return model


def test_shared_ancestors_are_written_once() -> None:
    text = json.dumps(build_rounds(12, 20).to_json())
    assert len(text) < 14 * len(json.dumps(build_rounds(1, 20).to_json()))


def test_provenance_with_shared_ancestors_round_trips() -> None:
    made = build_rounds(2, 3)
    again = Provenance.from_json(json.loads(json.dumps(made.to_json())))
    assert again == made
    assert Provenance.from_metadata(made.to_metadata()) == made


def test_provenance_with_repeated_ancestors_is_read() -> None:
    """Early versions of dmrl wrote such provenance."""
    made = build_rounds(1, 2)
    document = made.to_json()
    document["inputs"][1]["provenance"]["inputs"] = document["inputs"][0]["provenance"]["inputs"]
    assert Provenance.from_json(document) == made


def test_info_abbreviates_repeated_ancestors() -> None:
    lines = ancestry_lines(build_rounds(1, 2))
    assert [line.rpartition(", ")[2] for line in lines if "model-0" in line] == [
        f"made by: dmrl {Provenance('x').dmrl_version} train round=0",
        "as above",
    ]


def test_listed_settings_have_dotted_names_and_include_zero() -> None:
    made = Provenance("fly", {"eye": None, "vision": {"lost_share": 0.0, "lost": []}, "seed": 0})
    assert made.list_settings() == [("vision.lost_share", "0.0"), ("seed", "0")]
    assert ancestry_lines(made)[0].endswith(" fly vision.lost_share=0.0 seed=0")


def test_provenance_is_written_to_a_folder(tmp_path: Path) -> None:
    made = build_rounds(2, 2)
    made.write(tmp_path)
    text = (tmp_path / "provenance.json").read_text()
    assert Provenance.from_json(json.loads(text)) == made


def test_ancestors_beyond_the_limit_are_reduced_to_their_hash() -> None:
    made = Provenance("first")
    for k in range(300):
        made = Provenance(f"step {k}", inputs=(Input(f"{k}.mcap", f"{k:064x}", made),))
    back = Provenance.from_metadata(made.to_metadata())
    assert len(list(back.iter_ancestors())) == limits.ANCESTORS
    assert list(back.iter_ancestors())[-1][1].provenance is None
    assert Provenance.from_metadata(back.to_metadata()) == back


def test_a_provenance_that_nests_without_end_is_refused() -> None:
    deep = '{"inputs": [{"name": "a", "sha256": "b", "provenance": ' * 20_000
    with pytest.raises(ValueError, match="nests deeper"):
        Provenance.from_metadata({"stage": "a", "inputs": f"[{deep}"})


@pytest.mark.parametrize(
    "wrong",
    [
        {"settings": "x"},
        {"settings": 3},
        {"libraries": ["numpy"]},
        {"stage": 1},
        {"dmrl_version": None},
        {"seed": "x"},
        {"inputs": [3]},
    ],
)
def test_invalid_provenance_is_refused(wrong: dict[str, object]) -> None:
    document = Provenance("trim", {"to_s": 1.0}).to_json()
    with pytest.raises((TypeError, ValueError, KeyError)):
        Provenance.from_json(document | wrong)
