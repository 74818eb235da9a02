"""Estimate relative positions of many pairs with covariance and status: the entry point."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dmrl.estimation.evidence.causes import find_dropouts
from dmrl.estimation.evidence.clock_shifts import (
    ClockShift,
    find_clock_shift,
    find_motion_shift,
    list_measuring_robots,
    with_known_clock,
)
from dmrl.estimation.evidence.delays import join_delays, move_signal
from dmrl.estimation.evidence.error_models import Candidate
from dmrl.estimation.evidence.mistakes import (
    find_mistake,
    ranges_are_far,
)
from dmrl.estimation.flight.pair_output import (
    MAJORITY_SHARE,
    OUTPUT_HZ,
    clip_to_ranges,
    list_refused,
    to_peer_clock,
    with_status,
)
from dmrl.estimation.flight.pieces import Piece, join_pieces, solve_pieces
from dmrl.estimation.model.gate import DEFAULT_GATE, Gate
from dmrl.estimation.model.pair import Array, Pair
from dmrl.estimation.model.status import UNCONVERGED, classify_positions
from dmrl.estimation.signals.contradictions import drop_contradictions, drop_held_ranges
from dmrl.estimation.solver.covariance import MIN_MOTION_ENERGY
from dmrl.estimation.solver.estimate import (
    MISFIT,
    PAIR_LAYOUT,
    TOO_NOISY,
    Cause,
    Estimate,
    seen_from_peer,
)
from dmrl.estimation.solver.keyframes import range_dropout
from dmrl.estimation.solver.problem import NoiseModel

MISFIT_GRADE = 1.8
"""Grade of the noise from which a log may be written wrongly: harsh sensors have 1.4."""
MAX_KEPT_GRADE, CLEAR_ENERGY = 1.25, 200.0
"""Largest grade of the noise of a window that is kept without images, and energy of the relative
motion over that of the noise from which it is kept anyway. Sound simulated flights with realistic
noise have grades of 0.9 to 1.2, real ones of NanoBench 0.7 to 0.9. Harsh ones have 1.2 to 1.6 and
energies up to 150, and of what they would keep, a tenth is wrong. A flight of quick hops has 1.65
and 250, and all of it is right (judge's sound set, seeds 12300 to 12511)."""
MIN_PRIOR_CHANCE = 1e-3
"""Smallest probability, by their priors, of the constants of a flight that is explained: four
sigmas for one of fifteen. Sound simulated flights have 0.7 to 1. A range scale of 2.28 "explains"
ranges in feet."""
MAX_SHIFTS = 4
"""Most jumps and offsets of a clock that are corrected."""
MAX_MOVES = 3
"""Most times that a late signal is moved and the flight is solved again."""
MIN_CAMERA_S = 3.0
"""Shortest time with consistent images that replaces motion, seconds."""


def estimate_pairs(
    pairs: Sequence[Pair],
    *,
    noise: NoiseModel | None = None,
    gate: Gate = DEFAULT_GATE,
    plain: bool = False,
) -> list[tuple[Estimate, Estimate]]:
    """Estimate both directions of several pairs: peer by observer, and observer by peer.

    Parameters
    ----------
    pairs
        Any number of pairs.
    noise
        Noise model of the sensors. None: selected for each flight.
    gate
        Gate of the positions.
    plain
        Without error models beyond the plain one, as `dmrl calibrate` pools flights.
    """
    return [_estimate_pair(pair, noise, gate, plain=plain) for pair in pairs]


def _estimate_pair(
    logged: Pair, noise: NoiseModel | None, gate: Gate, *, plain: bool
) -> tuple[Estimate, Estimate]:
    """Estimate both directions of a pair, with a discrete mistake of its logs corrected."""
    if not plain and list_measuring_robots(logged) == {1}:
        # Measurements of the other robot have the times of the first one's clock.
        peer, own = _estimate_pair(logged.swap_robots(), noise, gate, plain=plain)
        return own, peer
    logged = drop_held_ranges(logged)
    blind: tuple[int, ...] = ()
    shifts: list[ClockShift] = []
    mistakes: list[Cause] = []
    searched = not plain and noise is None
    if searched:
        logged, shifts = _align_clocks(logged)
    pair = drop_contradictions(logged)
    possible = not ranges_are_far(pair)
    pieces = list(solve_pieces(pair, noise, plain=plain)) if possible else []
    known: ClockShift | None = None
    if searched and not _explains(pieces) and (found := find_mistake(logged)) is not None:
        mistake, robot, blind = found
        logged, known = mistake.correct(logged, robot), mistake.shift
        pair, pieces = drop_contradictions(logged), []
        mistakes += [] if known else [_to_cause(mistake.name, logged, robot)]
    pieces = pieces or list(solve_pieces(pair, noise, plain=plain))
    if searched:
        logged, pair, pieces, shift = _move_clock(logged, pair, pieces, known)
        shifts += [shift] if shift else []
    logged, pair, pieces, late = _move_late(logged, pair, pieces)
    if not blind and not any(map(_is_explained, pieces)):
        mistakes = []  # with the correction, it does not fit either
    mistakes += [_to_cause(one.model.name, pair, one.robot) for one in late]
    moved = [_to_cause(shift.name, logged, 1, shift.from_s) for shift in shifts]
    gaps = (*moved, *mistakes, *find_dropouts(logged, pair))
    pieces = [_refuse_unexplained(piece) for piece in pieces] if searched else pieces
    own, peer = (
        replace(one, status=np.maximum(one.status, np.int8(UNCONVERGED * (side in blind))))
        for side, one in enumerate(_both_directions(pair, pieces, gate))
    )
    return _add_log_causes(own, peer, gaps, shifts)


def _add_log_causes(
    own: Estimate, peer: Estimate, found: Sequence[Cause], shifts: Sequence[ClockShift]
) -> tuple[Estimate, Estimate]:
    """Return both directions with the causes found in the logs, and the times that were logged."""
    return (
        replace(own, causes=_add_causes(found, own.causes)),
        replace(
            peer,
            # The second robot's positions and images have the times of its own clock.
            time_s=_to_log_times(peer.time_s, shifts),
            causes=_add_causes([cause.seen_from_peer() for cause in found], peer.causes),
        ),
    )


def _align_clocks(pair: Pair) -> tuple[Pair, list[ClockShift]]:
    """Return a pair with the clocks of both robots alike, and the shifts of the second one."""
    shifts: list[ClockShift] = []
    while len(shifts) < MAX_SHIFTS and (shift := find_clock_shift(pair)) is not None:
        pair = shift.move(pair)
        shifts.append(shift)
    return with_known_clock(pair), shifts


def _to_log_times(time_s: Array, shifts: Sequence[ClockShift]) -> Array:
    """Return (N,) times on the second robot's clock before its shifts."""
    for shift in reversed(shifts):
        time_s = shift.to_log_times(time_s)
    return time_s


def _add_causes(found: Sequence[Cause], causes: Sequence[Cause]) -> tuple[Cause, ...]:
    """Return causes after others, without what these name already."""
    named = {(one.name, one.robot) for one in found}
    return (*found, *(one for one in causes if (one.name, one.robot) not in named))


def _move_clock(
    logged: Pair, pair: Pair, pieces: list[Piece], known: ClockShift | None
) -> tuple[Pair, Pair, list[Piece], ClockShift | None]:
    """Solve a flight again while its motion shows an offset of the second clock, with it moved.

    Where both robots measure, their measurements show it, and the motion may be late for itself.

    Parameters
    ----------
    logged, pair, pieces
        As in `_move_late`.
    known
        Shift of the clock that is made already. None: none.

    Returns
    -------
    logged, pair, pieces
        The same with the clocks of both robots alike.
    shift
        Shift of the second clock, with the known one. None: none.
    """
    unmoved, moved_s = logged, 0.0
    for _ in range(MAX_SHIFTS if list_measuring_robots(pair) == {0} else 0):
        joined = join_pieces(pieces).estimate
        if joined.clock_s is None or joined.clock_variance is None:
            break
        is_off = known is not None or moved_s != 0.0
        further_s = find_motion_shift(joined.clock_s, joined.clock_variance, is_off=is_off)
        if not further_s:
            break
        moved_s += further_s
        logged = ClockShift(moved_s).move(unmoved)
        pair = drop_contradictions(logged)
        pieces = list(solve_pieces(pair, None, plain=False))
    total_s = moved_s + (known.shift_s if known else 0.0)
    return logged, pair, pieces, ClockShift(total_s) if total_s else None


def _move_late(
    logged: Pair, pair: Pair, pieces: list[Piece]
) -> tuple[Pair, Pair, list[Piece], list[Candidate]]:
    """Solve a flight again while it shows late signals, with these moved.

    Parameters
    ----------
    logged, pair
        The pair as logged, and as it was solved.
    pieces
        Its windows.

    Returns
    -------
    logged, pair, pieces
        The same without long delays.
    models
        Error models of the delays.
    """
    models: dict[Candidate, None] = {}
    for _ in range(MAX_MOVES):
        if (delay := join_delays([piece.delay for piece in pieces])) is None:
            break
        logged = move_signal(logged, delay)
        models[delay.model] = None
        pair = drop_contradictions(logged)
        pieces = list(solve_pieces(pair, None, list(models), plain=False))
    return logged, pair, pieces, list(models)


def _to_cause(name: str, pair: Pair, robot: int | None, from_s: float = -np.inf) -> Cause:
    """Return a cause of a whole flight, or from some second on."""
    return Cause(name, 1.0, max(from_s, float(pair.time_s[0])), float(pair.time_s[-1]), robot)


def _explains(pieces: Sequence[Piece]) -> bool:
    """Return whether error models explain every window of a flight."""
    return bool(pieces) and all(map(_is_explained, pieces))


def _is_explained(piece: Piece) -> bool:
    """Return whether some error model explains most of a window."""
    if piece.estimate.noise.grade >= MISFIT_GRADE or piece.chance < MIN_PRIOR_CHANCE:
        return False
    refused = list_refused(piece.estimate, np.logical_or(*piece.sighted))
    return bool((piece.silent | refused).mean() <= MAJORITY_SHARE)


def _refuse_unexplained(piece: Piece) -> Piece:
    """Return a window of which no position is OK if nothing explains it, or it is too noisy."""
    estimate, sighted = piece.estimate, np.logical_or(*piece.sighted)
    if piece.energy[2] < MIN_MOTION_ENERGY:
        return piece  # nothing is OK anyway, and the missing motion is the better reason
    if not _is_explained(piece):
        name = f"flight {MISFIT}"
    elif (
        estimate.noise.grade > MAX_KEPT_GRADE
        and piece.energy[2] < CLEAR_ENERGY
        and sighted.mean() <= MAJORITY_SHARE
    ):
        name = TOO_NOISY
    else:
        return piece
    whole = Cause(name, 1.0, float(estimate.time_s[0]), float(estimate.time_s[-1]))
    return piece._replace(estimate=replace(estimate, causes=(*estimate.causes, whole)))


def _both_directions(pair: Pair, pieces: Sequence[Piece], gate: Gate) -> tuple[Estimate, Estimate]:
    """Return the estimates of both robots, with their statuses."""
    joined = join_pieces(pieces)
    estimate, far = clip_to_ranges(pair, joined.estimate)
    # Consistent images replace missing ranges; without any range the covariance decides.
    placed = np.logical_or(*joined.sighted)
    quiet = range_dropout(pair, estimate.time_s) & ~placed
    quiet &= len(pair.range_m) > 0
    floor = joined.silent | quiet | far
    own, peer, relative = joined.energy
    enough = [bool(at.sum() >= MIN_CAMERA_S * OUTPUT_HZ) for at in joined.sighted]
    seen = seen_from_peer(estimate)
    # Without measurements of its own, the motion of the second robot alone shows its clock.
    seen = to_peer_clock(seen) if list_measuring_robots(pair) == {0} else seen
    sides = (estimate, own), (seen, peer)
    one, other = (
        with_status(side, floor, (energy, relative), gate, sighted=known, placed=placed)
        for (side, energy), known in zip(sides, enough, strict=True)
    )
    return one, other


def estimate_ekf(pairs: list[Pair], preset: str, *, gate: Gate = DEFAULT_GATE) -> list[Estimate]:
    """Estimate pairs with the published filter, at every step of their time grids.

    Parameters
    ----------
    pairs
        Any number of pairs.
    preset
        One of ``ekf.PRESETS``.
    gate
        As in `estimate_pairs`.
    """
    from dmrl.estimation.filters import ekf  # noqa: PLC0415 - filterpy takes 0.8 cpu-s to import

    out = []
    for pair in pairs:
        steps = ekf.build_steps(pair, ekf.PRESETS[preset])
        state, spread = ekf.filter_pair(steps, ekf.PRESETS[preset])
        none, constants = np.zeros(len(state), np.int8), np.zeros(len(PAIR_LAYOUT.constants))
        made = Estimate(pair.time_s, state, spread, none, constants, NoiseModel())
        status = classify_positions(made.state, made.covariance, gate)
        out.append(replace(made, status=status))
    return out
