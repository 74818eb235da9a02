"""Long flights are solved in windows, with a prior carried from each window to the next."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dmrl.estimation.flight import windows
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.flight.windows import carry_information, split_windows
from dmrl.estimation.model.odometry import rotation_matrix
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver.levenberg_marquardt import Solver
from dmrl.estimation.solver.residuals import Values

from ..flights import build_pair, compute_truth, simulate_flight
from ..solver.test_residuals import build_flight


def test_windows_cover_a_flight_and_overlap() -> None:
    found = list(split_windows(10.0, 1010.0))
    assert [w.is_last for w in found] == [False] * (len(found) - 1) + [True]
    assert (found[0].from_s, found[-1].until_s, found[-1].end_s) == (10.0, 1010.0, 1010.0)
    for one, other in pairwise(found):
        assert one.until_s == other.from_s
        assert one.next_s == other.start_s
        assert one.end_s - other.start_s == windows.OVERLAP_S
        assert one.until_s == pytest.approx((one.end_s + other.start_s) / 2)
    assert max(w.end_s - w.start_s for w in found) <= 2 * windows.WINDOW_S - windows.OVERLAP_S
    (whole,) = split_windows(0.0, 2 * windows.WINDOW_S - windows.OVERLAP_S)
    assert whole.is_last


def test_carried_prior_informs_the_relative_position_only() -> None:
    problem, values = build_flight()
    values = Values(values.state, values.constants)
    solver = Solver(replace(problem, views=()))
    layout = solver.layout
    values = Values(values.state[:, : layout.width], values.constants[: len(layout.constants)] * 0)
    at = 9
    carried = carry_information(solver, values, float(problem.keyframe_s[at]))
    late = replace(solver, problem=windows._until(solver.problem, at))
    assert len(late.problem.links[0].range_m) == (solver.problem.links[0].keyframe <= at).sum()
    size = layout.width + len(layout.constants)
    assert carried.information.shape == (size, size)
    assert carried.convert(layout) == carried
    assert np.linalg.eigvalsh(carried.information).min() > -1e-6
    # There is information about the relative position, but not about the absolute one.
    absolute = np.zeros(size)
    absolute[[0, 3]] = 1.0
    relative = np.zeros(size)
    relative[0], relative[3] = -1.0, 1.0
    known, unknown = (v @ carried.information @ v for v in (relative, absolute))
    assert known > 1e3 * unknown
    assert carried.mean[:3] == pytest.approx(0.0)


def test_carried_prior_does_not_depend_on_the_frame_of_its_window() -> None:
    """A turned and shifted flight carries the same prior."""
    problem, values = build_flight()
    solver, by = Solver(problem), 0.7
    turned = values.state.copy()
    for robot in range(2):
        x, y, heading = problem.layout.pose(robot)
        turned[:, [x, y]] = values.state[:, [x, y]] @ rotation_matrix(np.array(by)).T + [3.0, -2.0]
        turned[:, heading] += by
    time_s = float(problem.keyframe_s[9])
    here, there = (
        carry_information(solver, Values(state, values.constants), time_s)
        for state in (values.state, turned)
    )
    assert there.mean == pytest.approx(here.mean, abs=1e-9)
    for one, other in ((here.information, there.information), (here.vector, there.vector)):
        assert other == pytest.approx(one, rel=1e-3, abs=1e-3 * np.abs(one).max())


@pytest.mark.heavy
def test_windowed_solve_is_as_accurate_as_whole_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    world = simulate_flight("random", "calibrated", 1002, 80.0)
    pair = build_pair(world)
    (whole,) = estimate_pairs([pair])
    monkeypatch.setattr(windows, "WINDOW_S", 30.0)
    monkeypatch.setattr(windows, "OVERLAP_S", 14.0)
    assert len(list(split_windows(0.0, 80.0))) == 4
    (parts,) = estimate_pairs([pair])
    assert parts[0].time_s == pytest.approx(whole[0].time_s)
    errors = [
        np.hypot(*(found[0].state[:, :2] - compute_truth(world, found[0].time_s)).T)
        for found in (whole, parts)
    ]
    rms = [float(np.sqrt((error**2).mean())) for error in errors]
    assert rms[1] < 1.5 * rms[0] + 0.02
    assert np.abs(np.diff(parts[0].state[:, :2], axis=0)).max() < 0.3
    assert (parts[0].status == OK).mean() > 0.6
    assert [cause for cause in parts[0].causes if cause.probability >= 0.5] == []


@pytest.mark.heavy
def test_a_carried_prior_keeps_a_bearing_that_the_window_leaves_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Positions late in the flight are more certain if the earlier window is carried over."""
    world = simulate_flight("random", "calibrated", 1002, 60.0)
    pair = build_pair(world)
    monkeypatch.setattr(windows, "WINDOW_S", 30.0)
    monkeypatch.setattr(windows, "OVERLAP_S", 10.0)
    kept = estimate_pairs([pair])[0][0]
    monkeypatch.setattr(windows, "CARRIED_SHARE", 1e-9)
    dropped = estimate_pairs([pair])[0][0]
    late = kept.time_s > 45
    widths = [
        float(np.sqrt(np.linalg.eigvalsh(e.covariance[late, :2, :2])[:, -1].mean()))
        for e in (kept, dropped)
    ]
    assert widths[0] < widths[1]
