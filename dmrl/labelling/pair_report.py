"""Report the estimate of each ordered pair in numbers, and explain rejected ones."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from dmrl.estimation.model.position_metrics import is_covered_by_truth
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver.estimate import Estimate, RejectionReason
from dmrl.labelling.flight_log import FlightLog
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK

MAX_GYRO_BIAS_RADPS, MAX_RANGE_OFFSET_M, MAX_SCALE_ERROR, MAX_CLOCK_OFFSET_S = 0.02, 0.2, 0.12, 0.05
"""Solved constants beyond these cause a warning: several times those of sound sensors."""

REFUSAL_TEXTS: dict[RejectionReason, str] = {
    "still": "{observer} hardly moves, and then ranges tell no bearing. Let it fly about",
    "alike": "they move alike, and then ranges tell no bearing. Let them fly different ways",
    "silent": "ranges or a sensor were silent for most of the flight. Try: dmrl info",
    "open": "the motion leaves the bearing open, or several solutions fit. Fly longer and faster, "
    "with turns; with a third robot try --method swarm",
    "imprecise": "a position is exact to {sigma_m:.2f} m, one sigma. Sensors may do better: see "
    "docs/labelling.md. A wider --gate-m takes more",
}
"""By reason: why no position of a flight is kept, and what to do about it."""


@dataclass(frozen=True, slots=True)
class PairReport:
    """One ordered pair.

    Parameters
    ----------
    observer, peer
        Their names.
    positions
        Number of positions.
    ok_share, ambiguous_share
        Shares of them with that status, 0 to 1.
    range_bias_m
        Offset of their ranges.
    gyro_difference_radps
        Bias of the peer's yaw rate less the observer's.
    sigma_m
        Median over the flight of sigma along the worst direction.
    rmse_ok_m, rmse_m
        Horizontal error of those that are OK, and of all; None without truth.
    refused
        Why no position is OK, in a word; None if one is.
    """

    observer: str
    peer: str
    positions: int
    ok_share: float
    ambiguous_share: float
    range_bias_m: float
    gyro_difference_radps: float
    sigma_m: float
    rmse_ok_m: float | None
    rmse_m: float | None
    refused: RejectionReason | None

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Return the headers of a table of reports."""
        return tuple(field.name for field in fields(cls))

    def row(self) -> tuple[Any, ...]:
        """Return the values under the headers."""
        return tuple(getattr(self, name) for name in self.columns())


def report_pair(
    flight: FlightLog,
    pair: tuple[str, str],
    positions: PeerPositions,
    estimate: Estimate,
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
        ok_share=float(ok.mean()),
        ambiguous_share=float((positions.status == STATUS_AMBIGUOUS).mean()),
        range_bias_m=estimate.value("range_offset", 0, 1),
        gyro_difference_radps=estimate.value("gyro_bias", 1) - estimate.value("gyro_bias", 0),
        sigma_m=float(np.median(sigma)),
        rmse_ok_m=_rms(error, ok),
        rmse_m=_rms(error, np.ones_like(ok)),
        refused=estimate.rejection_reason,
    )


def explain_refusals(
    pairs: Iterable[tuple[str, str]], estimates: Mapping[tuple[str, str], Estimate]
) -> list[str]:
    """Return a line for each ordered pair without an OK position, and for each suspect sensor.

    If no position is OK in either direction, suspect sensors are named in those lines: they are
    the causes that a user can fix.

    Parameters
    ----------
    pairs
        Each once: observer and peer.
    estimates
        Of the peer by the observer; the other way round too, where the method makes it.
    """
    lines = []
    for pair in pairs:
        off = find_suspect_sensors(pair, estimates[pair])
        ways = [way for way in (pair, pair[::-1]) if way in estimates]
        refused = {way: why for way in ways if (why := explain_refusal(way, estimates[way]))}
        if len(refused) < len(ways):
            lines += [f"{'-'.join(pair)}: {text}" for text in off]
            off = []
        lines += [
            f"{observer} sees {peer}: nothing is kept: {'; '.join([*off, why])}"
            for (observer, peer), why in refused.items()
        ]
    return lines


def explain_refusal(pair: tuple[str, str], estimate: Estimate) -> str | None:
    """Return why no position of a pair is OK, and what to do; None if one is.

    Parameters
    ----------
    pair
        Observer and peer.
    estimate
        Of the peer by the observer.
    """
    if (estimate.status == OK).any():
        return None
    largest = np.linalg.eigvalsh(estimate.covariance[:, :2, :2])[:, -1]
    why = REFUSAL_TEXTS[estimate.rejection_reason or "imprecise"]
    return why.format(observer=pair[0], sigma_m=float(np.sqrt(np.median(largest))))


def find_suspect_sensors(pair: tuple[str, str], estimate: Estimate) -> list[str]:
    """Return a line for each sensor whose solved constants are unusual, with what to do.

    Parameters
    ----------
    pair
        Observer and peer.
    estimate
        Of the peer by the observer.
    """
    said = []
    for side, robot in enumerate(pair):
        turn, scale = (estimate.value(name, side) for name in ("gyro_bias", "velocity_scale"))
        if abs(turn) > MAX_GYRO_BIAS_RADPS:
            said.append(
                f"{robot}'s yaw rate seems biased by {turn:.2g} rad/s; it was solved for. "
                "Let its gyroscope settle before the flight"
            )
        if abs(scale) > MAX_SCALE_ERROR:
            said.append(
                f"{robot}'s velocity seems {abs(scale):.0%} too "
                f"{'large' if scale > 0 else 'small'}; it was solved for. Is its height right? "
                "Where it is so in every flight: dmrl calibrate --sensors"
            )
    offset_m, clock_s = estimate.value("range_offset", 0, 1), estimate.value("clock", 1)
    if abs(offset_m) > MAX_RANGE_OFFSET_M:
        said.append(
            f"ranges seem {offset_m:+.2f} m off; it was solved for. Measure it once, "
            "and give it with --range-offset-m, or let flights tell: dmrl calibrate --sensors"
        )
    if abs(clock_s) > MAX_CLOCK_OFFSET_S:
        said.append(f"{pair[1]}'s log seems {clock_s:+.2f} s off. Try: dmrl align")
    return said


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
