"""Poses of a Crazyflie log combine a position with the orientation of its time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.formats.crazyflie.log_block import TimeSeries
from dmrl.formats.crazyflie.log_variables import _combine_pose

GROWING = st.lists(st.integers(0, 9), min_size=1, max_size=6).map(sorted)


@given(GROWING, GROWING)
@pytest.mark.heavy
def test_pose_takes_the_orientation_of_its_time_or_the_next(
    places: list[int], turns: list[int]
) -> None:
    place = TimeSeries(np.array(places), np.arange(3.0 * len(places)).reshape(-1, 3))
    turn = TimeSeries(np.array(turns), -1 - np.arange(4.0 * len(turns)).reshape(-1, 4))
    found = _combine_pose(place, turn)
    assert found is not None
    if both := sorted(set(places) & set(turns)):
        wanted = [(t, places.index(t), turns.index(t)) for t in both]
    else:
        later = [sum(t < at for t in turns) for at in places]
        wanted = [(t, k, min(later[k], len(turns) - 1)) for k, t in enumerate(places)]
    assert found[0].tolist() == [t for t, _, _ in wanted]
    rows = [[*place.values[a], *turn.values[b]] for _, a, b in wanted]
    assert found[1].tolist() == rows
