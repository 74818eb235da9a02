"""Evaluate the estimated positions of a recording against the ground truth, pair by pair."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import RecordingError
from dmrl.estimation.model.position_metrics import (
    DEFINITIONS,
    MAX_GOOD_ERROR_M,
    ErrorTrace,
    EvaluatedPositions,
    combine_figures,
    compute_figures,
    is_covered_by_truth,
)
from dmrl.evaluation.figure_tables import describe_source, finite_values, format_values
from dmrl.evaluation.limit import Bound, describe_limit, find_limit
from dmrl.geometry.frames import Array
from dmrl.labelling.flight_log import TRUTH_TOPICS, FlightLog, read_flight
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.messages import STATUS_OK
from dmrl.recording import read_summary

TITLE, EACH = "estimated positions against truth", "pair"
Times = NDArray[np.int64]
COVERED_DEFINITION = (
    "share of the true positions that lie between two estimates close in time; all other metrics "
    "use the existing estimates only"
)
"""Definition of the metric ``covered``."""
LIMIT_DEFINITION = (
    "posterior Cramer-Rao bound: the least error of a smoother that knows the simulator's noise; "
    "rmse_m from the start, settled_rmse_m after the settling time, kept_share by bad share"
)
"""Definition of ``limit``; null unless `dmrl fly` simulated the flight, with noise."""


@dataclass(frozen=True, slots=True)
class EvaluatedPair:
    """Evaluated estimates of one robot about one peer.

    Parameters
    ----------
    robot, peer
        Names.
    judged
        The estimates with ground truth.
    without_truth
        Number of estimates without ground truth.
    true
        Number of samples of the truth.
    covered
        Number of them between two estimates that are close in time. Dropouts lower it.
    bound
        (N, 2, 2) least covariances of the estimates with ground truth; None if unknown.
    """

    robot: str
    peer: str
    judged: EvaluatedPositions
    without_truth: int
    true: int
    covered: int
    bound: Array | None = None

    @property
    def name(self) -> str:
        """Label for a table."""
        return f"{self.robot} sees {self.peer}"

    @property
    def trace(self) -> ErrorTrace:
        """Errors over time, with the kept estimates apart from the rejected ones."""
        kept = self.judged.kept[:, None]
        return ErrorTrace(
            f"{self.name}: estimate minus truth",
            f"position-error-{self.robot}-{self.peer}",
            self.judged.time_s,
            self.judged.sigma_m,
            {
                "left out": np.where(kept, np.nan, self.judged.error_m),
                "kept": np.where(kept, self.judged.error_m, np.nan),
            },
        )


def has_positions(recording: Path) -> bool:
    """Return whether a recording has estimated positions."""
    return bool(_find_estimated_pairs(read_summary(recording).topics))


def _find_estimated_pairs(held: Iterable[str]) -> list[tuple[str, str]]:
    found = (topics.parse_topic(topics.POSITION, topic) for topic in held)
    return sorted((n["robot"], n["peer"]) for n in found if n is not None)


def judge(recording: Path) -> list[EvaluatedPair]:
    """Evaluate every pair with estimates and truth.

    Parameters
    ----------
    recording
        Recording with ``/<robot>/peer/<peer>/position`` and the truth; see
        `labelling.ground_truth`.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has no pair with both.
    """
    held = read_flight(recording, topics.POSITION, *TRUTH_TOPICS)
    estimated, known = _find_estimated_pairs(held.topics), list_true_pairs(held.topics)
    if not estimated:
        raise RecordingError(f"{recording} has no positions. Try: dmrl label {recording} OUT.mcap")
    limit = find_limit(held)
    judged = [names for names in estimated if names in known]
    pairs = [evaluate_pair(held, limit, *names, held.positions[names]) for names in judged]
    pairs = [pair for pair in pairs if len(pair.judged.time_s)]
    if not pairs:
        raise RecordingError(
            f"{recording} has no true position for any estimated one. Use a simulated flight, "
            "or one with motion capture"
        )
    return pairs


class PairPaths(NamedTuple):
    """Estimates of one robot about one peer, at times with ground truth.

    ``time_ns`` (N,) log times, ``estimate_m`` and ``true_m`` (N, 2) in the robot's horizontal
    frame, ``covariance`` (N, 2, 2) square metres, ``kept`` (N,) True where the status is OK,
    ``started_ns`` the first log time of all its estimates.
    """

    time_ns: Times
    estimate_m: Array
    true_m: Array
    covariance: Array
    kept: NDArray[np.bool_]
    started_ns: float


def read_paths(recording: Path) -> dict[tuple[str, str], PairPaths]:
    """Read the estimated and the true path of every pair that has both.

    Raises
    ------
    RecordingError
        If the recording cannot be read.
    """
    held = read_flight(recording, topics.POSITION, *TRUTH_TOPICS)
    known = list_true_pairs(held.topics)
    pairs = [pair for pair in _find_estimated_pairs(held.topics) if pair in known]
    return {p: _match_truth(held.positions[p], *find_true_path(held, *p)) for p in pairs}


def _match_truth(estimate: PeerPositions, true_ns: Times, true_m: Array) -> PairPaths:
    time_ns = estimate.time_ns
    near = is_covered_by_truth(time_ns, true_ns)
    return PairPaths(
        time_ns[near],
        estimate.xyz_m[near, :2],
        np.stack([np.interp(time_ns[near], true_ns, axis) for axis in true_m.T[:2]], axis=1)
        if near.any()
        else np.empty((0, 2)),
        estimate.covariance[near, :2, :2],
        estimate.status[near] == STATUS_OK,
        float(time_ns[0]) if len(time_ns) else 0.0,
    )


def evaluate_pair(
    held: FlightLog, limit: Bound | None, robot: str, peer: str, estimate: PeerPositions
) -> EvaluatedPair:
    """Evaluate estimates of one robot about one peer against the truth of a flight."""
    true_ns, true_m = find_true_path(held, robot, peer)
    found = _match_truth(estimate, true_ns, true_m)
    judged = EvaluatedPositions(
        time_s=np.asarray((found.time_ns - found.started_ns) * 1e-9, float),
        error_m=found.estimate_m - found.true_m,
        covariance=found.covariance,
        distance_m=np.linalg.norm(found.true_m, axis=1),
        kept=found.kept,
    )
    time_ns = estimate.time_ns
    covered = is_covered_by_truth(true_ns, time_ns)
    without_truth, seen = len(time_ns) - len(found.kept), int(covered.sum())
    least = limit and limit((robot, peer), found.time_ns)
    return EvaluatedPair(robot, peer, judged, without_truth, len(covered), seen, least)


def lasts_s(pairs: list[EvaluatedPair]) -> float:
    """Return the time from the first to the last estimate of the longest pair, seconds."""
    return max(float(pair.judged.time_s[-1]) for pair in pairs)


def document(recording: Path, pairs: list[EvaluatedPair], settle_s: float) -> dict[str, Any]:
    """Return all metrics as JSON values; null where a metric is undefined."""
    each = [compute_figures(pair.judged, settle_s) for pair in pairs]
    return {
        "recording": describe_source(recording),
        "settle_s": settle_s,
        "overall": {
            "covered": _compute_coverage(pairs),
            **finite_values(asdict(combine_figures(each))),
        },
        "limit": _describe_limit(pairs, settle_s),
        "pairs": [
            {
                "robot": pair.robot,
                "peer": pair.peer,
                "without_truth": pair.without_truth,
                "covered": _compute_coverage([pair]),
                **finite_values(asdict(measured)),
                "limit": _describe_limit([pair], settle_s),
            }
            for pair, measured in zip(pairs, each, strict=True)
        ],
        "definitions": {**DEFINITIONS, "covered": COVERED_DEFINITION, "limit": LIMIT_DEFINITION},
    }


def _describe_limit(pairs: Sequence[EvaluatedPair], settle_s: float) -> dict[str, Any] | None:
    whole = [pair.bound for pair in pairs if pair.bound is not None]
    late = [pair.judged.time_s >= settle_s for pair in pairs]
    settled = [bound[at] for bound, at in zip(whole, late, strict=False)]
    return describe_limit(whole, settled) if whole else None


def _compute_coverage(pairs: list[EvaluatedPair]) -> float:
    return sum(pair.covered for pair in pairs) / sum(pair.true for pair in pairs)


# Name of a figure, its words in the table, and its format.
COLUMNS = (
    ("samples", "samples", "d"),
    ("covered", "covered", ".0%"),
    ("rmse_m", "RMSE, m", ".2f"),
    ("limit", "bound, m", ".2f"),
    ("p95_m", "95 %, m", ".2f"),
    ("wrong_basin", "wrong", ".0%"),
    ("nees", "NEES", ".1f"),
    ("coverage_95", "in 95 %", ".0%"),
    ("kept", "kept", ".0%"),
    ("precision", "precision", ".1%"),
    ("recall", "recall", ".0%"),
    ("kept_rmse_m", "RMSE of kept, m", ".2f"),
)


def note(made: Mapping[str, Any]) -> str:
    """Describe the columns of the table of a ``document``."""
    shares = (made.get("limit") or {"kept_share": {}})["kept_share"].items()
    kept = ", ".join(f"{share:.0%} at {float(bad):.0%} bad" for bad, share in shares)
    bound = f"; bound: the least RMSE with this noise, which allows to keep {kept}" if kept else ""
    return (
        "errors are horizontal; covered: share of the truth that has an estimate; kept: status "
        f"OK; good: error of {MAX_GOOD_ERROR_M:g} m at most; precision: share of "
        "the kept that is good; recall: share of the good that is kept; these cover the whole "
        f"flight. From {made['settle_s']:g} s on: RMSE; 95 %: 95th percentile of the error; wrong: "
        "share of pairs with an error of half their distance; NEES: squared error over "
        "covariance, 2 if the covariance is right; in 95 %: share of the truth "
        "inside the 95 % ellipse"
        f"{bound}"
    )


def rows(made: Mapping[str, Any]) -> list[list[str]]:
    """Return one row per pair of a ``document``, and one for all if there are several."""
    named = [(f"{pair['robot']} sees {pair['peer']}", pair) for pair in made["pairs"]]
    if len(named) > 1:
        named.append(("all", {**made["overall"], "limit": made.get("limit")}))
    # Of the limit, the figure that stands beside the RMSE.
    limits = [(values.get("limit") or {}).get("settled_rmse_m") for _, values in named]
    return [
        [name, *format_values({**values, "limit": limit}, COLUMNS)]
        for (name, values), limit in zip(named, limits, strict=True)
    ]
