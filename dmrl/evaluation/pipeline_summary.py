"""Print the results of a pipeline: tables of its evaluations, and the paths of its images."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dmrl.evaluation import positions, tracks
from dmrl.evaluation.figure_tables import format_values, metric_columns
from dmrl.guards.bounded_parsing import parse_json
from dmrl.terminal.tables import print_json, print_line, print_note, print_table


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """Outcome of a step: made, up to date already, or left out because it could not be made."""

    stage: str
    out: Path
    seconds: float
    skipped: bool
    left_out: bool = False


EVALUATION_FILE = "evaluation.json"
ERRORS_3D = {"positions": positions, "tracks": tracks}
"""Evaluations of 3D positions, in files of their name, with the module that formats each."""
METRIC_COLUMNS = metric_columns(
    *("median_px", "within_8_px", "within_20_px", "depth_mae_m", "recall", "f1", "ap_16_px")
)


def print_report(done: Sequence[StepOutcome], *, as_json: bool = False) -> None:
    """Print the results of a pipeline: a row per evaluation, and the paths of its images.

    Parameters
    ----------
    done
        Outcomes of the steps, from ``run``.
    as_json
        Print one JSON document instead: seconds per step, evaluations, images.
    """
    evaluations = _read_documents(done, EVALUATION_FILE)
    judged = {kind: _read_documents(done, f"{kind}.json") for kind in ERRORS_3D}
    pictures = [picture for d in done if _is_result(d) for picture in _list_images(d.out)]
    if as_json:
        steps = [asdict(d) for d in done]
        print_json({"steps": steps, "evaluations": evaluations, **judged, "pictures": pictures})
        return
    for kind, documents in judged.items():
        module = ERRORS_3D[kind]
        for name, document in documents.items():
            headers = [words for _, words, _ in module.COLUMNS]
            print_table(name, ["", *headers], module.rows(document))
            print_note(module.note(document))
    rows = [(name, *_format_row(document)) for name, document in evaluations.items()]
    headers = [title for _, title, _ in METRIC_COLUMNS]
    if rows:
        print_table("", ["evaluation", "against", "images", *headers], rows)
    for picture in pictures:
        print_line(str(picture))


def _read_documents(done: Sequence[StepOutcome], name: str) -> dict[str, dict[str, Any]]:
    """Read the JSON documents of this name, by output folder."""
    return {
        d.out.name: parse_json((d.out / name).read_text(encoding="utf-8"))
        for d in done
        if d.stage == "evaluate" and not d.left_out and (d.out / name).is_file()
    }


def _format_row(document: dict[str, Any]) -> list[str]:
    values = {name: document["overall"][name]["value"] for name, _, _ in METRIC_COLUMNS}
    cells = format_values(values, METRIC_COLUMNS)
    return [document["against"], str(document["images"]), *cells]


def _is_result(done: StepOutcome) -> bool:
    # Images that sketch draws for training are data, not results.
    return done.stage != "sketch" and not done.left_out


def _list_images(out: Path) -> list[Path]:
    if out.is_dir():
        return sorted(out.rglob("*.png"))
    return [out] if out.suffix == ".png" and out.exists() else []
