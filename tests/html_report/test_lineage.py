"""The graph of a provenance: one box a stage and round, arrows from what it was made from."""

from dmrl.html_report.lineage import build_lineage
from dmrl.recording import Input, Provenance


def _made(stage: str, *inputs: Input) -> Provenance:
    return Provenance(stage, inputs=inputs)


def test_lineage_has_columns_with_counts_and_rounds() -> None:
    fly = [_made("fly"), _made("fly")]
    label = [_made("label", Input(f"f{k}", f"{k}", fly[k])) for k in range(2)]
    train = _made("train", Input("a", "10", label[0]), Input("b", "11", label[1]))
    again = _made("label", Input("f0", "0", fly[0]), Input("model", "20", train))
    made = dict(zip("abcdef", [*fly, *label, train, again], strict=True))
    columns, arrows = build_lineage(made)
    assert columns == [["fly x2"], ["label x2"], ["train"], ["label, round 2"]]
    assert set(arrows) == {
        ("fly x2", "label x2"),
        ("label x2", "train"),
        ("fly x2", "label, round 2"),
        ("train", "label, round 2"),
    }


def test_files_of_others_are_sources() -> None:
    columns, arrows = build_lineage({"a": _made("convert", Input("log.csv", "1"))})
    assert columns == [["file log.csv"], ["convert"]] and arrows == [("file log.csv", "convert")]
    many = _made("convert", *(Input(f"{k}.csv", f"{k}") for k in range(40)))
    columns, _ = build_lineage({"a": many})
    assert len(columns[0]) == 13 and columns[0][-1] == "more files"


def test_lineage_without_outputs_is_empty() -> None:
    assert build_lineage({}) == ([], [])
