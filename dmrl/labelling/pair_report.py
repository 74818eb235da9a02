"""Report the estimate of each ordered pair in numbers, with the causes of its errors."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dmrl.estimation.evidence.mistakes import OF_BOTH_ROBOTS, OF_ONE_ROBOT
from dmrl.estimation.model.gate import DEFAULT_GATE, Gate
from dmrl.estimation.model.position_metrics import is_covered_by_truth
from dmrl.estimation.solver.estimate import MISFIT, REASONS, Estimate
from dmrl.labelling.flight_log import FlightLog
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK

SURE = 0.5
"""Smallest probability of a cause that is printed."""
MANY_PAIRS = 4
"""Number of pairs with the same cause that share a line."""
LATE = (
    "Subtract the sensor's delay from its times; where all sensors of the robot are late: "
    "dmrl align"
)
CLEAR_LINE = "Keep walls, people and metal out of the line between the antennas"
REMEDIES = {
    "yaw": "Let its gyroscope settle before the flight",
    "yaw rate late": LATE,
    "flow": "Fly over a lit floor with texture",
    "flow scale": "Is its height right? Where it is so in every flight: dmrl calibrate --sensors",
    "flow bias": "Where it is so in every flight: dmrl calibrate --sensors",
    "flow bias changes": "Fly over a lit floor with texture, and level the sensor",
    "flow mounted askew": "Turn the sensor straight, or its values when the log is written",
    "flow follows the turning": "Where is the sensor? Mount it in the middle of the robot",
    "flow late": LATE,
    "range": "Measure the offset once, and give it with --range-offset-m, or let flights "
    "determine it: dmrl calibrate --sensors",
    "range error follows distance": "Measure ranges at known distances, and correct them when the "
    "log is written",
    "range late": LATE,
    "range silent": "Log at least two a second, and fly within reach of the radio",
    "range offset changes": CLEAR_LINE,
    "range errors": CLEAR_LINE,
    "antenna": "Turn the antennas upright, away from metal",
    "height": "Fly over a level floor, within reach of the range finder",
    "height silent": "Log it at least once a second; fly within reach of the range finder",
    "clock": "Let both robots range, and try: dmrl align",
    "robot": "The ranges then show no bearing. Let both fly about, different ways",
    "sensors": "Or do odometry and ranges contradict each other? Check the signs and frames of "
    "both robots: docs/own_robot.md",
    "bearing": "Fly longer and faster, with turns, or with a third robot",
    "odometry": "Fly slower, over a lit floor with texture, or with a third robot",
    "positions": "A wider --gate-m takes more: see docs/labelling.md",
    "robots": "Fly different ways, or exchange the names of the robots",
}
"""What to do about a cause, by the words that its name begins with; the most words count."""
MISFIT_REMEDY = "No known error explains it; positions around are refused. Try: dmrl view"
"""What to do about a signal that does not fit."""
FITS = re.compile(" fits? (if|in) ")
"""Words of a cause that is corrected: a discrete mistake."""


@dataclass(frozen=True, slots=True)
class PairCause:
    """A cause by the names of the robots.

    Parameters
    ----------
    name, probability, from_s, to_s
        As in `Cause`; times since the first message of the recording.
    robot
        Robot with the sensor. None: the pair's.
    """

    name: str
    probability: float
    from_s: float
    to_s: float
    robot: str | None

    @property
    def title(self) -> str:
        """Name of the cause, and whose sensor it is."""
        return f"{self.robot}'s {self.name}" if self.robot else self.name

    def __str__(self) -> str:
        """Return the cause in a line, with what to do about it."""
        if self.name.endswith(MISFIT):
            remedy = MISFIT_REMEDY
        elif OF_ONE_ROBOT in self.name:
            remedy = "Nothing shows of which one, so no position is kept. Correct the log"
        elif OF_BOTH_ROBOTS in self.name:
            remedy = "Correct the logs of both, and label again"
        elif FITS.search(self.name):
            remedy = "The labels use it so; write the log so too"
        else:
            remedy = REMEDIES[max(filter(self.name.startswith, REMEDIES), key=len)]
        return (
            f"{self.title} ({self.probability:.0%}, {self.from_s:.0f} to {self.to_s:.0f} s). "
            f"{remedy}"
        )


COLUMNS = (
    ("robot", "robot", ""),
    ("peer", "peer", ""),
    ("positions", "positions", "d"),
    ("kept_share", "kept", ".1%"),
    ("ambiguous_share", "ambiguous", ".1%"),
    ("range_bias_m", "range bias, m", ".2f"),
    ("sigma_m", "median sigma, m", ".2f"),
    ("rmse_ok_m", "RMSE of kept, m", ".2f"),
    ("rmse_m", "RMSE, m", ".2f"),
)
"""Name of a value, its words in the table, and its format."""


@dataclass(frozen=True, slots=True)
class PairReport:
    """One ordered pair.

    Parameters
    ----------
    robot, peer
        Observer and peer.
    positions
        Number of positions.
    kept_share, ambiguous_share
        Shares of them with status OK and AMBIGUOUS, 0 to 1.
    range_bias_m
        Offset of their ranges.
    sigma_m
        Median over the flight of sigma along the worst direction.
    rmse_ok_m, rmse_m
        Horizontal error of those that are OK, and of all; None without truth.
    causes
        Errors of sensors that the flight shows; empty where the plain model fits.
    """

    robot: str
    peer: str
    positions: int
    kept_share: float
    ambiguous_share: float
    range_bias_m: float
    sigma_m: float
    rmse_ok_m: float | None
    rmse_m: float | None
    causes: list[PairCause]

    @staticmethod
    def columns() -> tuple[str, ...]:
        """Return the headers of a table of reports."""
        return (*(words for _, words, _ in COLUMNS), "causes")

    def row(self) -> tuple[str, ...]:
        """Return the texts under the headers; a dash for an unknown value."""
        values = [(getattr(self, name), form) for name, _, form in COLUMNS]
        cells = ("-" if value is None else format(value, form) for value, form in values)
        return (
            *cells,
            "; ".join(cause.title for cause in self.causes if cause.probability >= SURE),
        )


def report_pair(
    flight: FlightLog, pair: tuple[str, str], positions: PeerPositions, estimate: Estimate
) -> PairReport:
    """Return the report of one ordered pair.

    Parameters
    ----------
    flight
        With the true positions, if there are any.
    pair
        Observer and peer.
    positions, estimate
        Positions as written, and the estimate that they were sampled from.
    """
    ok = positions.status == STATUS_OK
    error = _horizontal_errors(flight, pair, positions)
    sigma = np.sqrt(np.linalg.eigvalsh(positions.covariance[:, :2, :2])[:, -1])
    return PairReport(
        *pair,
        positions=len(ok),
        kept_share=float(ok.mean()),
        ambiguous_share=float((positions.status == STATUS_AMBIGUOUS).mean()),
        range_bias_m=estimate.value("range_offset", 0, 1),
        sigma_m=float(np.median(sigma)),
        rmse_ok_m=_rms(error, ok),
        rmse_m=_rms(error, np.ones_like(ok)),
        causes=name_causes(pair, estimate),
    )


def name_causes(pair: tuple[str, str], estimate: Estimate) -> list[PairCause]:
    """Return the causes of an estimate by the names of its observer and peer."""
    return [
        PairCause(
            cause.name, round(cause.probability, 3), round(cause.from_s, 2), round(cause.to_s, 2),
            None if cause.robot is None else pair[cause.robot],
        )
        for cause in estimate.causes
    ]  # fmt: skip


def explain_causes(reports: Iterable[PairReport], gate: Gate = DEFAULT_GATE) -> list[str]:
    """Return a line for each probable cause of a pair, once for both directions.

    A cause that many pairs share has one line. Where positions are imprecise, it says what the gate
    compares.
    """
    shared: dict[str, dict[tuple[str, PairCause], PairReport]] = {}
    for report in reports:
        names = "-".join(sorted((report.robot, report.peer)))
        for cause in report.causes:
            if cause.probability >= SURE:
                shared.setdefault(cause.title, {}).setdefault((names, cause), report)
    lines: list[str] = []
    for found in shared.values():
        pairs = list(dict.fromkeys(names for names, _ in found))
        if len(pairs) < MANY_PAIRS:
            lines += [
                f"{names}: {cause}{_name_gate([report], cause, gate)}"
                for (names, cause), report in found.items()
            ]
            continue
        cause = _join([cause for _, cause in found])
        some = f"{len(pairs)} pairs ({', '.join(pairs[:3])}, ...)"
        lines.append(f"{some}: {cause}{_name_gate(list(found.values()), cause, gate)}")
    return lines


def _join(causes: list[PairCause]) -> PairCause:
    """Return a cause of several pairs: its largest probability, from its first to its last time."""
    return replace(
        causes[0],
        probability=max(one.probability for one in causes),
        from_s=min(one.from_s for one in causes),
        to_s=max(one.to_s for one in causes),
    )


def _name_gate(reports: list[PairReport], cause: PairCause, gate: Gate) -> str:
    if cause.name != REASONS["imprecise"]:
        return ""
    sigma = " to ".join(dict.fromkeys(f"{f(r.sigma_m for r in reports):.2f}" for f in (min, max)))
    return (
        f". With a median sigma of {sigma} m, over {gate.bad_share:.0%} (--bad-share) "
        f"even of the best would be over {gate.error_m:g} m (--gate-m) off"
    )


def _rms(error: Any, chosen: Any) -> float | None:
    if error is None:
        return None
    square = error[chosen & np.isfinite(error)] ** 2
    return float(np.sqrt(square.mean())) if len(square) else None


def _horizontal_errors(flight: FlightLog, pair: tuple[str, str], positions: PeerPositions) -> Any:
    """Return (N,) errors, metres, NaN outside the truth; None if there is no truth."""
    if pair not in list_true_pairs(flight.topics):
        return None
    time_ns, true_m = find_true_path(flight, *pair)
    if len(time_ns) < 2:
        return None
    offsets = [
        np.interp(positions.time_ns, time_ns, true) - values
        for true, values in zip(true_m.T[:2], positions.xyz_m.T[:2], strict=True)
    ]
    return np.where(is_covered_by_truth(positions.time_ns, time_ns), np.hypot(*offsets), np.nan)
