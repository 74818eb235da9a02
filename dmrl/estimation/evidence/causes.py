"""Causes of a flight: the error models that are probable, with their times."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dmrl.estimation.evidence.posterior import Mixture
from dmrl.estimation.model.pair import MAX_DROPOUT_S, Array, Pair
from dmrl.estimation.solver.estimate import Cause, Innovation
from dmrl.estimation.solver.keyframes import longest_range_gap_s

MIN_DROPOUT_SHARE = 0.01
"""Share of a flight from which a silent sensor is reported."""
MIN_PROBABILITY = 0.1
"""Smallest probability of a cause that is reported."""


def find_causes(mixture: Mixture, span_s: tuple[float, float]) -> tuple[Cause, ...]:
    """Return the causes of a window, most probable first.

    Parameters
    ----------
    mixture
        Solutions of the window under likely models.
    span_s
        First and last second of the window.
    """
    found = [
        Cause(candidate.model.name, probability, *span_s, candidate.robot)
        for candidate, probability in mixture.probabilities().items()
        if probability >= MIN_PROBABILITY
    ]
    return tuple(sorted(found, key=lambda cause: -cause.probability))


def join_causes(causes: Sequence[Cause]) -> tuple[Cause, ...]:
    """Return causes with those of the same name and robot as one.

    Stretches that are refused stay apart unless they touch.
    """
    out: list[Cause] = []
    for cause in sorted(causes, key=lambda one: one.from_s):
        before = next(
            (
                k
                for k, one in enumerate(out)
                if (one.name, one.robot) == (cause.name, cause.robot)
                and (not cause.refuses or cause.from_s <= one.to_s + MAX_DROPOUT_S)
            ),
            None,
        )
        if before is None:
            out.append(cause)
        else:
            one = out[before]
            probability = max(one.probability, cause.probability)
            out[before] = replace(one, probability=probability, to_s=max(one.to_s, cause.to_s))
    return tuple(sorted(out, key=lambda cause: -cause.probability))


def join_innovations(parts: Sequence[Sequence[Innovation]]) -> tuple[Innovation, ...]:
    """Join the innovations of the windows of a flight, by signal and robot."""
    found: dict[tuple[str, int | None], list[Innovation]] = {}
    for one in (one for part in parts for one in part):
        found.setdefault((one.signal, one.robot), []).append(one)
    return tuple(
        replace(
            some[0],
            time_s=np.concatenate([one.time_s for one in some]),
            size=np.concatenate([one.size for one in some]),
        )
        for some in found.values()
    )


def find_dropouts(logged: Pair, used: Pair) -> tuple[Cause, ...]:
    """Return the sensors that were silent, repeated one value, or were dropped.

    Parameters
    ----------
    logged, used
        The pair as logged, and as it was estimated.
    """
    found: list[Cause] = []
    for robot, (before, after) in enumerate(((logged.own, used.own), (logged.peer, used.peer))):
        turning = before.dropout if before.turn_dropout is None else before.turn_dropout
        height = np.zeros_like(turning) if after.height_dropout is None else after.height_dropout
        masks = {
            "yaw rate silent, in spikes or saturated": turning,
            "flow silent, stuck or saturated": before.dropout & ~turning,
            "height silent or impossible": height,
            "flow runs away or robot lies still": after.dropout & ~before.dropout,
        }
        found += [
            _cause(name, used.time_s[mask], robot)
            for name, mask in masks.items()
            if mask.mean() > MIN_DROPOUT_SHARE
        ]
    held = np.isin(logged.range_time_s, used.range_time_s, invert=True)
    if held.sum() > MIN_DROPOUT_SHARE * len(held):
        found.append(_cause("range frozen", logged.range_time_s[held], None))
    edges = np.concatenate([used.time_s[:1], used.range_time_s, used.time_s[-1:]])
    gaps_s = np.diff(edges)
    silent = np.flatnonzero(gaps_s > longest_range_gap_s(used))
    if len(used.range_m) and gaps_s[silent].sum() > MIN_DROPOUT_SHARE * (edges[-1] - edges[0]):
        found.append(_cause("range silent", edges[[silent[0], silent[-1] + 1]], None))
    return tuple(found)


def _cause(name: str, time_s: Array, robot: int | None) -> Cause:
    """Return a cause that the measurements show by themselves."""
    return Cause(name, 1.0, float(time_s.min()), float(time_s.max()), robot)
