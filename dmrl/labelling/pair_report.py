"""What was estimated of each ordered pair, in numbers."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from dmrl.estimation.model.position_metrics import inside_truth
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver.estimate import Estimate, Refused
from dmrl.estimation.solver.residuals import (
    BIAS,
    CLOCK,
    OWN_GYRO,
    OWN_SCALE,
    PEER_GYRO,
    PEER_SCALE,
)
from dmrl.labelling.ground_truth import true_pairs, true_path
from dmrl.labelling.image_labels import Positions
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK
from dmrl.recording import Contents

TURNS_RADPS, LONGER_M, FASTER, LATER_S = 0.02, 0.2, 0.12, 0.05
"""What was solved for is worth a line beyond these: several times what sensors in order have."""

WHY: dict[Refused, str] = {
    "still": "{observer} hardly moves, and then ranges tell no bearing. Let it fly about",
    "alike": "they move alike, and then ranges tell no bearing. Let them fly different ways",
    "silent": "ranges or a sensor were silent for most of the flight. Try: dmrl info",
    "open": "the motion leaves the bearing open, or several solutions fit. Fly longer and faster, "
    "with turns; with a third robot try --method swarm",
    "imprecise": "a position is exact to {sigma_m:.2f} m, one sigma. Sensors may do better: see "
    "docs/labelling.md. A wider --gate-m takes more",
}
"""Why nothing of a flight is kept, and what to do about it."""


@dataclass(frozen=True, slots=True)
class PairReport:
    """One ordered pair.

    Parameters
    ----------
    observer, peer
        Their names.
    positions
        How many.
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
        Why nothing is OK, in a word; None where something is.
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
    refused: Refused | None

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Headers of a table of reports."""
        return tuple(field.name for field in fields(cls))

    def row(self) -> tuple[Any, ...]:
        """The values under the headers."""
        return tuple(getattr(self, name) for name in self.columns())


def pair_report(
    held: Contents,
    pair: tuple[str, str],
    positions: Positions,
    estimate: Estimate,
) -> PairReport:
    """The report of one ordered pair.

    Parameters
    ----------
    held
        Where the truth may be.
    pair
        Observer and peer.
    positions
        As written.
    estimate
        Where they come from.
    """
    ok = positions.status == STATUS_OK
    error = _errors(held, pair, positions)
    sigma = np.sqrt(np.linalg.eigvalsh(positions.covariance[:, :2, :2])[:, -1])
    return PairReport(
        *pair,
        positions=len(ok),
        ok_share=float(ok.mean()),
        ambiguous_share=float((positions.status == STATUS_AMBIGUOUS).mean()),
        range_bias_m=float(estimate.constants[BIAS]),
        gyro_difference_radps=float(estimate.constants[PEER_GYRO] - estimate.constants[OWN_GYRO]),
        sigma_m=float(np.median(sigma)),
        rmse_ok_m=_rms(error, ok),
        rmse_m=_rms(error, np.ones_like(ok)),
        refused=estimate.refused,
    )


def reasons(
    pairs: Iterable[tuple[str, str]], estimates: Mapping[tuple[str, str], Estimate]
) -> list[str]:
    """One line for each ordered pair of which nothing is kept, and for each sensor that is off.

    Where nothing is kept in either direction, what is off stands in those lines: it is the reason
    that somebody can do something about.

    Parameters
    ----------
    pairs
        Each once: observer and peer.
    estimates
        Of the peer by the observer; the other way round too, where the method makes it.
    """
    lines = []
    for pair in pairs:
        off = doubts(pair, estimates[pair])
        ways = [way for way in (pair, pair[::-1]) if way in estimates]
        refused = {way: why for way in ways if (why := refusal(way, estimates[way]))}
        if len(refused) < len(ways):
            lines += [f"{'-'.join(pair)}: {text}" for text in off]
            off = []
        lines += [
            f"{observer} sees {peer}: nothing is kept: {'; '.join([*off, why])}"
            for (observer, peer), why in refused.items()
        ]
    return lines


def refusal(pair: tuple[str, str], estimate: Estimate) -> str | None:
    """Why nothing of a pair is kept, and what to do; None where something is.

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
    why = WHY[estimate.refused or "imprecise"]
    return why.format(observer=pair[0], sigma_m=float(np.sqrt(np.median(largest))))


def doubts(pair: tuple[str, str], estimate: Estimate) -> list[str]:
    """What a solve found to be off, sensor by sensor, with what to do about it.

    Parameters
    ----------
    pair
        Observer and peer.
    estimate
        Of the peer by the observer.
    """
    found, said = estimate.constants, []
    for robot, turn, scale in zip(
        pair, found[[OWN_GYRO, PEER_GYRO]], found[[OWN_SCALE, PEER_SCALE]], strict=True
    ):
        if abs(turn) > TURNS_RADPS:
            said.append(
                f"{robot}'s yaw rate seems biased by {turn:.2g} rad/s; it was solved for. "
                "Let its gyroscope settle before the flight"
            )
        if abs(scale) > FASTER:
            said.append(
                f"{robot}'s velocity seems {abs(scale):.0%} too "
                f"{'large' if scale > 0 else 'small'}; it was solved for. Is its height right? "
                "Where it is so in every flight: dmrl calibrate --sensors"
            )
    if abs(found[BIAS]) > LONGER_M:
        said.append(
            f"ranges seem {found[BIAS]:+.2f} m off; it was solved for. Measure it once, "
            "and give it with --range-offset-m, or let flights tell: dmrl calibrate --sensors"
        )
    if abs(found[CLOCK]) > LATER_S:
        said.append(f"{pair[1]}'s log seems {found[CLOCK]:+.2f} s off. Try: dmrl align")
    return said


def _rms(error: Any, chosen: Any) -> float | None:
    if error is None:
        return None
    square = error[chosen & np.isfinite(error)] ** 2
    return float(np.sqrt(square.mean())) if len(square) else None


def _errors(held: Contents, pair: tuple[str, str], positions: Positions) -> Any:
    """(N,) horizontal errors, metres, NaN outside the truth; None where there is no truth."""
    if pair not in true_pairs(held.topics):
        return None
    time_ns, true_m = true_path(held, *pair)
    if len(time_ns) < 2:
        return None
    offsets = [
        np.interp(positions.time_ns, time_ns, true) - values
        for true, values in zip(true_m.T[:2], positions.xyz_m.T[:2], strict=True)
    ]
    return np.where(inside_truth(positions.time_ns, time_ns), np.hypot(*offsets), np.nan)
