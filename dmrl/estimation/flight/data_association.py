"""Resolve candidates that the solutions of two peers of one camera share.

Every pair is solved by itself and uses the candidates that fit. If two solutions use the same
candidates, one of them is wrong, or its own peer is out of view. The candidates stay with the peer
whom they fit better over the whole flight. The other pair is solved again without them.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from dmrl.estimation.model.bearings import Association, associate, drop_candidates
from dmrl.estimation.model.pair import BearingMeasurements, Pair
from dmrl.estimation.solver.estimate import Estimate

Names = tuple[str, str]
CONFLICT_SHARE = 0.1
"""Smallest share of a pair's associated images that another pair fits better, from which it is
solved again. No record of how the value was chosen."""


def resolve_conflicts(
    pairs: Mapping[Names, Pair], estimates: Mapping[Names, Estimate]
) -> dict[Names, Pair]:
    """Return the pairs to solve again, without candidates claimed by another peer.

    Parameters
    ----------
    pairs
        Pairs by names, with the bearings of their cameras; each pair of robots once.
    estimates
        Estimates of every ordered pair.
    """
    out: dict[Names, Pair] = {}
    for robot in sorted({name for names in pairs for name in names}):
        mine = {names: pair for names, pair in pairs.items() if robot in names}
        claims = {
            names: _associate_peer(robot, names, pair, estimates) for names, pair in mine.items()
        }
        for one, other in combinations(mine, 2):
            a, b = claims[one], claims[other]
            if a is None or b is None:
                continue
            both = a.is_consistent & b.is_consistent & (a.nearest == b.nearest)
            first = a.log_likelihood[both].sum() < b.log_likelihood[both].sum()
            loser, lost = (one, a) if first else (other, b)
            if both.sum() > CONFLICT_SHARE * lost.is_consistent.sum():
                before = out.get(loser, mine[loser])
                sees = _camera_bearings(robot, loser, mine[loser])
                assert sees is not None
                left = drop_candidates(sees, both, lost.nearest)
                out[loser] = (
                    replace(before, own_bearings=left)
                    if loser[0] == robot
                    else replace(before, peer_bearings=left)
                )
    return out


def _camera_bearings(robot: str, names: Names, pair: Pair) -> BearingMeasurements | None:
    """Return the bearing measurements of one robot of a pair."""
    return pair.own_bearings if names[0] == robot else pair.peer_bearings


def _associate_peer(
    robot: str, names: Names, pair: Pair, estimates: Mapping[Names, Estimate]
) -> Association | None:
    """Associate a robot's images with its peer; None without images."""
    sees = _camera_bearings(robot, names, pair)
    if sees is None or not len(sees.time_s):
        return None
    own, peer = (pair.own, pair.peer) if names[0] == robot else (pair.peer, pair.own)
    found = estimates[names if names[0] == robot else names[::-1]]
    xy, spread, _ = found.interpolate_at(sees.time_s)
    z = np.interp(sees.time_s, pair.time_s, peer.height_m - own.height_m)
    covariance = np.zeros((len(z), 3, 3))
    covariance[:, :2, :2], covariance[:, 2, 2] = spread, found.noise.height_std_m**2
    return associate(sees, np.column_stack([xy, z]), covariance)
