"""Estimate all pairs of robots of a flight, in groups, side by side."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any, Literal

from dmrl.estimation.flight.data_association import resolve_conflicts
from dmrl.estimation.flight.pairs import estimate_ekf, estimate_pairs
from dmrl.estimation.flight.swarm import estimate_swarm, select_connected
from dmrl.estimation.model.gate import Gate
from dmrl.estimation.model.pair import Pair
from dmrl.estimation.solver.estimate import Estimate
from dmrl.guards.memory import keep_freed_memory
from dmrl.labelling.flight_log import RobotPair
from dmrl.terminal.progress import say, track

MAX_GROUP = 15
"""Most pairs that are filtered side by side: more are no faster, and need more memory."""
MIN_GROUP = 4
"""Fewest pairs of a process."""
KEPT_BYTES = 24 << 20
"""Freed bytes that a process keeps: the arrays of an iteration over a window."""
MIN_PARALLEL_S = 300.0
"""Flight time of all pairs from which more processes pay off, seconds: each starts in a second."""

Method = Literal["batch", "swarm", "ekf"]
Spread = Callable[[Callable[..., Any], Sequence[Any], int], Iterator[Any]]
"""A function, its items and a number of processes to the results in their order."""


@dataclass(frozen=True, slots=True)
class PairSolver:
    """Method of estimation, without the processes that run it.

    Parameters
    ----------
    method
        As in ``dmrl.stages.label.Settings``.
    preset
        Noise of the method "ekf".
    gate
        Gate of the positions.
    plain
        Without error models beyond the plain one.
    """

    method: Method
    preset: str
    gate: Gate
    plain: bool = False

    def solve(self, pairs: list[Pair]) -> Sequence[tuple[Estimate, Estimate | None]]:
        """Return the estimates of the peer and, unless the method is "ekf", of the observer."""
        keep_freed_memory(KEPT_BYTES)
        if self.method == "ekf":
            return [(one, None) for one in estimate_ekf(pairs, self.preset, gate=self.gate)]
        return estimate_pairs(pairs, gate=self.gate, plain=self.plain)


def orient_pair(pairs: Mapping[RobotPair, Pair], name: RobotPair) -> Pair:
    """Return a pair with the first robot of its name as the observer."""
    return pairs[name] if name in pairs else pairs[name[::-1]].swap_robots()


def estimate_all(
    pairs: Mapping[RobotPair, Pair], solver: PairSolver, workers: int, spread: Spread
) -> dict[RobotPair, Estimate]:
    """Estimate every ordered pair; solve those again that claim the same detections.

    Robots that ranges connect are estimated together by the method "swarm". Those that this does
    not explain are estimated pair by pair.

    Parameters
    ----------
    pairs
        Each pair of robots once, by the names of both.
    solver
        How to estimate.
    workers, spread
        Most processes, and the function that runs them.
    """
    together = (
        _estimate_together(pairs, solver, workers, spread) if solver.method == "swarm" else {}
    )
    alone = {names: pair for names, pair in pairs.items() if names not in together}
    estimates = together | _estimate(alone, solver, workers, spread)
    if again := resolve_conflicts(pairs, estimates):
        estimates |= _estimate(again, solver, workers, spread)
    return dict(sorted(estimates.items()))


def _estimate_together(
    pairs: Mapping[RobotPair, Pair], solver: PairSolver, workers: int, spread: Spread
) -> dict[RobotPair, Estimate]:
    """Estimate the robots that ranges connect, and name those that are left out."""
    connected = select_connected(pairs)
    starts = _estimate(connected, replace(solver, plain=True), workers, spread)
    progress = partial(track, what="Solving together")
    together = estimate_swarm(connected, starts, gate=solver.gate, progress=progress)
    if left_out := sorted({*chain(*connected)} - {*chain(*together)}):
        why = "no error model fits them all, clocks disagree, or times of flight differ"
        say(f"{', '.join(left_out)}: estimated pair by pair, as {why}")
    return together


def _estimate(
    pairs: Mapping[RobotPair, Pair], solver: PairSolver, workers: int, spread: Spread
) -> dict[RobotPair, Estimate]:
    names = list(pairs)
    if solver.method == "ekf":
        names += [(other, one) for one, other in names]
    if sum(pair.time_s[-1] - pair.time_s[0] for pair in pairs.values()) < MIN_PARALLEL_S:
        workers = 1
    size = min(MAX_GROUP, max(-(-len(names) // workers), MIN_GROUP))
    groups = [names[k : k + size] for k in range(0, len(names), size)]
    oriented = [[orient_pair(pairs, name) for name in group] for group in groups]
    solved = spread(solver.solve, oriented, workers)
    out: dict[RobotPair, Estimate] = {}
    for group in track(groups, "Estimating"):
        for name, (of_peer, of_observer) in zip(group, next(solved), strict=True):
            out[name] = of_peer
            if of_observer is not None:
                out[name[::-1]] = of_observer
    return out
