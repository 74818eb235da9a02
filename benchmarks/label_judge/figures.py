"""Figures of a labelled flight, and of a row of the table over its flights."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dmrl.evaluation.limit import describe_limit
from dmrl.evaluation.positions import PairPaths, read_paths
from dmrl.samples.flight import START_NS
from label_judge.flights import Array

BAD_M, CHI2_95 = 0.3, 5.991
REFUSED_SHARE = 0.01
"""A flight with a smaller share of kept positions counts as refused."""


@dataclass(frozen=True)
class FlightFigures:
    """Sums over all positions of one flight, kept or not, from the first second.

    Parameters
    ----------
    positions, expected
        Number of positions with truth, and number of true positions.
    squared_error, squared_sigma, squared_bound
        Sums, m^2; that of the bound is NaN if it is unknown.
    worst_pair_m
        Largest RMSE of an observer and its peer.
    inside, kept, bad
        Number of positions in the 95 % ellipse; with status OK; of these, with an error over 0.3 m.
    keepable
        By bad share: number of positions that a smoother with the covariances of the bound could
        keep.
    named, said
        Causes with a probability of 0.5 or more in the labels; and the warnings printed.
    error
        The error with which the command failed, or "".
    cpu_s
        CPU seconds; the start-up is shared among the recordings of the folder.
    """

    positions: int = 0
    expected: int = 0
    squared_error: float = 0.0
    squared_sigma: float = 0.0
    squared_bound: float = 0.0
    worst_pair_m: float = 0.0
    inside: int = 0
    kept: int = 0
    bad: int = 0
    keepable: Mapping[str, float] | None = None
    named: str = ""
    said: str = ""
    error: str = ""
    cpu_s: float = 0.0


def judge_flight(
    labelled: Path, beside: Path | None, result: Mapping[str, Any], moving: Sequence[str] = ()
) -> FlightFigures:
    """Compute the figures of one labelled flight.

    Parameters
    ----------
    labelled
        Recording with estimates and truth; it may not exist.
    beside
        File with the covariances of the bound; None if there is none.
    result
        Its entry in the output of `dmrl label --json`.
    moving
        Only pairs of these robots count. Empty: all.
    """
    said = _find_words(result)
    bounds = np.load(beside) if beside is not None else {}
    expected = sum(len(bounds[key]) for key in bounds if key.endswith("-s"))
    if not labelled.exists():
        return FlightFigures(expected=expected, **said)
    paths = read_paths(labelled)
    if moving:
        paths = {pair: path for pair, path in paths.items() if {*pair} <= {*moving}}
    error = np.concatenate([path.estimate_m - path.true_m for path in paths.values()])
    covariance = np.concatenate([path.covariance for path in paths.values()])
    kept = np.concatenate([path.kept for path in paths.values()])
    size = np.hypot(*error.T)
    least = [_interpolate(bounds, *one) for one in paths.items() if "-".join(one[0]) in bounds]
    limit = describe_limit(least, least)["kept_share"] if least else {}
    return FlightFigures(
        positions=len(size),
        expected=expected or len(size),
        squared_error=float((size**2).sum()),
        squared_sigma=float(np.nan_to_num(np.trace(covariance, axis1=1, axis2=2)).sum()),
        squared_bound=float(np.trace(np.concatenate(least), axis1=1, axis2=2).sum())
        if least
        else float("nan"),
        worst_pair_m=max(
            float(np.sqrt(((path.estimate_m - path.true_m) ** 2).sum(axis=1).mean()))
            for path in paths.values()
        ),
        inside=int((_mahalanobis_squared(error, covariance) <= CHI2_95).sum()),
        kept=int(kept.sum()),
        bad=int((size[kept] > BAD_M).sum()),
        keepable={share: part * len(size) for share, part in limit.items()},
        **said,
    )


def _interpolate(bounds: Mapping[str, Array], pair: tuple[str, str], path: PairPaths) -> Array:
    """Interpolate the bound of a pair's covariance (N, 2, 2) to the times of its path."""
    name = "-".join(pair)
    time_s = (path.time_ns - START_NS) * 1e-9
    entries = bounds[name].reshape(-1, 4).T
    return np.stack([np.interp(time_s, bounds[f"{name}-s"], e) for e in entries], 1).reshape(
        -1, 2, 2
    )


def _mahalanobis_squared(error: Array, covariance: Array) -> Array:
    """Return (N,) squared Mahalanobis distances of errors (N, 2), infinite if singular."""
    (a, b), (_, d) = covariance.transpose(1, 2, 0)
    x, y = error.T
    determinant = a * d - b * b
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = (d * x * x - 2 * b * x * y + a * y * y) / determinant
    return np.where(determinant > 0, squared, np.inf)


def _find_words(result: Mapping[str, Any]) -> dict[str, str]:
    """Return the probable causes, the warnings and the error of a flight, each as one text."""
    inner = result.get("result") or {}
    causes = [cause for pair in inner.get("pairs", ()) for cause in pair.get("causes") or ()]
    sure = [c for c in causes if c.get("probability", 1.0) >= 0.5]
    named = {f"{c.get('robot') or ''} {c['name']}".strip() for c in sure}
    lines = {re.sub(r"^\w+ sees \w+: ", "", line) for line in inner.get("warnings", ())}
    return {
        "named": "; ".join(sorted(named)),
        "said": "; ".join(sorted(lines)),
        "error": str(result.get("error") or ""),
    }


@dataclass(frozen=True)
class RowFigures:
    """Figures of a row: root mean squares over flights, and shares of all positions.

    ``median_m`` and ``ratio`` are medians over flights of the RMSE, and of the RMSE over the bound.
    ``least_ellipse`` is the smallest share of a flight in the ellipse, and ``worst_kept_m`` the
    largest RMSE of a flight that keeps any position. ``near`` is the share of flights whose causes
    or warnings name the cause. If there is no cause, it is the share that names one nevertheless.
    """

    flights: int
    rmse_m: float
    median_m: float
    worst_kept_m: float
    worst_pair_m: float
    ratio: float
    sigma_m: float
    bound_m: float
    ellipse: float
    least_ellipse: float
    kept: float
    kept_of_limit: float
    kept_of_sound: float
    bad: float
    worst: float
    said: float
    near: float
    failed: int
    cpu_s: float


def combine(
    flights: Sequence[FlightFigures], cause: str, sound: Sequence[FlightFigures] = ()
) -> RowFigures:
    """Combine the flights of a row.

    Parameters
    ----------
    flights
        Figures of each flight.
    cause
        Regular expression that matches a correct name of the cause.
    sound
        Figures of the same flights without the fault.
    """
    made = [f for f in flights if f.positions]
    positions, expected = sum(f.positions for f in made), sum(f.expected for f in flights)
    kept = sum(f.kept for f in flights)

    def root(name: str) -> float:
        each = [getattr(f, name) / f.positions for f in made]
        return float(np.sqrt(np.mean(each))) if each else float("nan")

    keepable = sum((f.keepable or {}).get("0.02", 0.0) for f in flights)
    sound_kept = sum(f.kept for f in sound)
    # Labels without causes, as of older versions, count by their warnings or their error.
    words = [f.named or f.said or f.error for f in flights]
    near = [re.search(cause, w, re.IGNORECASE) is not None for w in words]
    if not cause:
        near = [bool(f.named) for f in flights]
    sizes = [np.sqrt(f.squared_error / f.positions) for f in made]
    ratios = [np.sqrt(f.squared_error / f.squared_bound) for f in made]
    shares = [f.bad / f.kept for f in flights if f.kept]
    return RowFigures(
        flights=len(flights),
        rmse_m=root("squared_error"),
        median_m=float(np.median(sizes)) if sizes else float("nan"),
        worst_kept_m=max((s for s, f in zip(sizes, made, strict=True) if f.kept), default=0.0),
        worst_pair_m=max((f.worst_pair_m for f in made), default=0.0),
        ratio=float(np.median(ratios)) if ratios else float("nan"),
        sigma_m=root("squared_sigma"),
        bound_m=root("squared_bound"),
        ellipse=_divide(sum(f.inside for f in made), positions),
        least_ellipse=min((f.inside / f.positions for f in made), default=float("nan")),
        kept=_divide(kept, expected),
        kept_of_limit=_divide(kept, keepable),
        kept_of_sound=_divide(kept, sound_kept),
        bad=_divide(sum(f.bad for f in flights), kept),
        worst=max(shares, default=float("nan")),
        said=float(np.mean([bool(w) for w in words])),
        near=float(np.mean(near)),
        failed=sum(1 for f in flights if f.error),
        cpu_s=float(np.mean([f.cpu_s for f in flights])),
    )


def _divide(part: float, whole: float) -> float:
    """Return a share, or NaN of nothing."""
    return part / whole if whole else float("nan")
