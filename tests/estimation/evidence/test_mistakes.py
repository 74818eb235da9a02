from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.evidence.mistakes import MISTAKES

from ..flights import flown, pair_of

BY_NAME = {mistake.name: mistake for mistake in MISTAKES}


def test_sign_correction_applies_to_one_robot() -> None:
    pair = pair_of(flown("in_view", "calibrated", 1000, 20.0))
    wrong = replace(pair, peer=replace(pair.peer, yaw_rate_radps=-pair.peer.yaw_rate_radps))
    again = BY_NAME["yaw rate fits if it is negated"].apply(wrong, 1)
    assert np.array_equal(again.peer.yaw_rate_radps, pair.peer.yaw_rate_radps)
    assert again.own is pair.own


def test_velocities_in_the_take_off_frame_are_rotated_back() -> None:
    pair = pair_of(flown("in_view", "calibrated", 1000, 20.0))
    heading = np.cumsum(pair.peer.yaw_rate_radps) * pair.dt_s
    x, y = pair.peer.vx_mps, pair.peer.vy_mps
    turned = replace(
        pair.peer,
        vx_mps=np.cos(heading) * x - np.sin(heading) * y,
        vy_mps=np.sin(heading) * x + np.cos(heading) * y,
    )
    mistake = BY_NAME["flow fits in the world frame"]
    assert mistake.heading_is_open
    again = mistake.apply(replace(pair, peer=turned), 1)
    assert again.peer.vx_mps == pytest.approx(x)
    assert again.peer.vy_mps == pytest.approx(y)
