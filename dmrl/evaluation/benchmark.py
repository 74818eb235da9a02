"""Scores of a submission to the benchmark: its figures over sealed seeds, as JSON values."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dmrl.errors import SettingError, SourceError
from dmrl.estimation.model.position_metrics import combine_figures, compute_figures
from dmrl.evaluation.figure_specs import find_value
from dmrl.evaluation.positions import evaluate_pair
from dmrl.guards.bounded_parsing import parse_json
from dmrl.labelling.flight_log import TRUTH_TOPICS, read_flight
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.messages import STATUS_OK
from dmrl.recording import build_input, read_summary
from dmrl.recording.provenance_inputs import read_provenance

FIGURES = {
    "detect": {
        name: f"overall.{name}.value"
        for name in ("median_px", "within_20_px", "depth_mae_m", "ap_16_px", "recall", "precision")
    },
    "follow": {"held": "flights.0.held_to_end"}
    | {name: f"flights.0.{name}" for name in ("held_s", "contacts", "recall", "false_per_image")},
    "label_with_uwb": {"kept": "overall.kept", "good_of_kept": "overall.precision"}
    | {name: f"overall.{name}" for name in ("kept_rmse_m", "rmse_m")},
}
"""Figures of each task, by their place in the document of ``dmrl evaluate``."""
FIGURES["label_without_uwb"] = FIGURES["label_with_uwb"]
COLUMNS = ("sha256", "robot", "peer", "log_time_ns", "x_m", "y_m", "z_m", "sigma_m", "kept")
"""Columns of labels: the recording that they were made from, and positions as dmrl label writes."""
COPY_M, COPIED_SHARE = 1e-4, 0.05
"""Labels nearer to the truth than the first are copies; a larger share of them is refused."""


def score_documents(task: str, outputs: Sequence[Path]) -> dict[str, Any]:
    """Return the figures of a task over the outputs of ``dmrl evaluate``, one a seed.

    Raises
    ------
    SourceError
        If an output is no JSON document and no folder with one.
    """
    found = []
    for path in outputs:
        file = next(iter(sorted(path.glob("*.json"))), path) if path.is_dir() else path
        try:
            found.append(parse_json(file.read_text(encoding="utf-8")))
        except (OSError, ValueError) as e:
            raise SourceError(f"{path} is no output of dmrl evaluate --plots ({e})") from None
    return spread_figures(task, found)


def spread_figures(task: str, documents: Sequence[Any]) -> dict[str, Any]:
    """Return mean, standard deviation over seeds and values of each figure of a task."""
    out: dict[str, Any] = {}
    for name, at in FIGURES[task].items():
        values = [find_value(one, at) for one in documents]
        known = np.array([v for v in values if isinstance(v, int | float)], float)
        mean = float(known.mean()) if len(known) else None
        std = float(known.std(ddof=1)) if len(known) > 1 else None
        out[name] = {"mean": mean, "std": std, "values": values}
    return out


def refuse_sealed(submitted: Path, scenes: Sequence[Path]) -> None:
    """Raise SettingError if the provenance of a submission holds a recording of the benchmark.

    Raises
    ------
    SettingError
        If so: it was made with the truth.
    """
    sealed = {build_input(scene).sha256: scene.name for scene in scenes}
    seeds = {(made.seed, made.settings.get("trajectory")): scene.name
             for scene in scenes if (made := read_summary(scene).provenance)}  # fmt: skip
    near = submitted if submitted.is_dir() else submitted.parent
    made = read_provenance(submitted) or read_provenance(near)
    for _, source in made.iter_ancestors() if made else ():
        own = source.provenance
        key = (own.seed, own.settings.get("trajectory")) if own and own.stage == "fly" else None
        if name := sealed.get(source.sha256) or seeds.get(key):  # type: ignore[arg-type]
            raise SettingError(
                f"{submitted} was made from {name}, a recording of the benchmark with its truth. "
                "Train and label without it"
            )


def score_labels(
    labels: Path, scenes: Sequence[Path], inputs: Mapping[str, Sequence[Path]]
) -> dict[str, Any]:
    """Score positions in a CSV file against the truth of the scenes.

    Parameters
    ----------
    labels
        CSV with the columns of `COLUMNS`.
    scenes
        Recordings with the truth.
    inputs
        By task: the recordings without the truth that go to participants, in the same order.

    Raises
    ------
    SettingError
        If labels were made from a recording with the truth, from none of the benchmark, or are the
        truth.
    SourceError
        If the file is no such table.
    """
    rows = _read_rows(labels)
    truth = {build_input(scene).sha256: scene.name for scene in scenes}
    made_from = {
        build_input(path).sha256: (task, scene)
        for task, paths in inputs.items()
        for path, scene in zip(paths, scenes, strict=True)
    }
    documents: dict[str, list[Any]] = {}
    for sha256, mine in rows.items():
        if name := truth.get(sha256):
            raise SettingError(f"{labels}: made from {name}, which holds the truth. Use its input")
        if sha256 not in made_from:
            raise SettingError(
                f"{labels}: sha256 {sha256[:16]} is of no input of the benchmark. Label public-*, "
                "or blind-*, in its folder"
            )
        task, scene = made_from[sha256]
        documents.setdefault(task, []).append(_judge_scene(labels, scene, mine))
    return {task: spread_figures(task, found) for task, found in documents.items()}


def _read_rows(labels: Path) -> dict[str, dict[tuple[str, str], list[list[float]]]]:
    """Return time, x, y, z, sigma and kept of every row, by recording and by pair."""
    found: dict[str, dict[tuple[str, str], list[list[float]]]] = {}
    try:
        with labels.open(encoding="utf-8", newline="") as stream:
            for row in csv.DictReader(stream):
                values = [float(row[name]) for name in COLUMNS[4:8]]
                if not all(map(math.isfinite, values)) or values[3] <= 0:
                    raise ValueError(f"values {values}")
                pairs = found.setdefault(row["sha256"], {})
                one = [int(row["log_time_ns"]), *values, float(row["kept"])]
                pairs.setdefault((row["robot"], row["peer"]), []).append(one)
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as e:
        raise SourceError(f"{labels}: {e}. It needs the columns {', '.join(COLUMNS)}") from None
    if not found:
        raise SourceError(f"{labels} holds no label. It needs the columns {', '.join(COLUMNS)}")
    return found


def _judge_scene(
    labels: Path, scene: Path, mine: Mapping[tuple[str, str], list[list[float]]]
) -> dict[str, Any]:
    held = read_flight(scene, *TRUTH_TOPICS)
    known = list_true_pairs(held.topics)
    if wrong := sorted(set(mine) - set(known)):
        raise SettingError(f"{labels}: {scene.name} has no pair {' and '.join(wrong[0])}. Fix it")
    figures = []
    for pair, values in mine.items():
        rows = sorted(values)
        time_ns = np.array([row[0] for row in rows], np.int64)
        xyz, sigma, kept = (np.array([row[k] for row in rows]) for k in (slice(1, 4), 4, 5))
        true_ns, true_m = find_true_path(held, *pair)
        exact = np.column_stack([np.interp(time_ns, true_ns, axis) for axis in true_m.T])
        copied = (np.linalg.norm(xyz - exact, axis=1) < COPY_M).mean()
        if copied > COPIED_SHARE:
            raise SettingError(
                f"{labels}: {copied:.0%} of the positions of {' and '.join(pair)} are the truth "
                f"of {scene.name}. Submit estimates"
            )
        spread = sigma[:, None, None] ** 2 * np.eye(3)
        status = np.where(kept > 0, STATUS_OK, STATUS_OK + 1).astype(np.int8)
        judged = evaluate_pair(held, None, *pair, PeerPositions(time_ns, xyz, spread, status))
        figures.append(compute_figures(judged.judged, 0.0))
    overall = combine_figures(figures)
    return {"overall": asdict(overall)}
