"""The Cramer-Rao bound of a simulated flight in the output of `evaluate`."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.evaluation.evaluate_recordings import print_document
from dmrl.evaluation.limit import describe_limit
from dmrl.evaluation.positions import document, judge
from dmrl.flight import NOISE, Scenario, simulate
from dmrl.flight.bound import compute_bound
from dmrl.messages import STATUS_OK, message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.recording.provenance import Input
from dmrl.samples.flight import START_NS
from dmrl.simulation.flight_recording import FlySettings

pytestmark = pytest.mark.heavy

SETTINGS = FlySettings(duration_s=20.0, noise="harsh", seed=4)


def _write_flight(
    path: Path,
    settings: dict[str, Any] | None = None,
    *,
    part_s: tuple[float, float] = (0.0, 20.0),
    shift_m: float = 0.0,
) -> Path:
    """Write truth and estimates of a flight, with the provenance of `dmrl label` of `dmrl fly`."""
    settings = asdict(SETTINGS) if settings is None else settings
    made = Provenance("label", inputs=(Input("a.mcap", "0" * 64, Provenance("fly", settings)),))
    flight = simulate(Scenario(duration_s=20.0), NOISE["harsh"], 4)
    time_s = np.arange(part_s[0], part_s[1], 0.05)
    spread = (np.eye(3) * 0.04).ravel().tolist()
    with RecordingWriter(path, made) as sink:
        for robot, peer in (("cf1", "cf2"), ("cf2", "cf1")):
            place = flight.peer_in_horizontal(robot, peer, time_s) + np.array([shift_m, 0, 0])
            stamps = START_NS + np.rint(flight.clocks[robot].to_clock_time(time_s) * 1e9)
            for at, (x, y, z) in zip(stamps.astype(int).tolist(), place.tolist(), strict=True):
                true = message_class("PeerPosition")(x=x, y=y, z=z, covariance=[0.0] * 9)
                found = message_class("PeerPosition")(
                    x=x + 0.1, y=y, z=z, covariance=spread, status=STATUS_OK
                )
                sink.write(at, topics.TRUTH(robot, peer), true)
                sink.write(at, topics.POSITION(robot, peer), found)
    return path


def _compute_limit(path: Path, settle_s: float = 10.0) -> Any:
    """Return the limit that the evaluation of a flight states."""
    return document(path, judge(path), settle_s)["limit"]


def test_evaluate_reports_the_bound_of_a_smoother(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _write_flight(tmp_path / "a.mcap")
    made = document(path, judge(path), 10.0)
    flight = simulate(Scenario(duration_s=20.0), NOISE["harsh"], 4)
    bound = compute_bound(flight, NOISE["harsh"])
    at_s = np.arange(0.0, 20.0, 0.05)
    variances = [
        np.trace(bound.interpolate_at(link, at_s), axis1=1, axis2=2) for link in bound.covariances
    ]
    limit = made["limit"]
    assert limit["rmse_m"] == pytest.approx(np.sqrt(np.mean(variances)), rel=1e-6)
    late = np.sqrt(np.mean([variance[200:] for variance in variances]))
    assert limit["settled_rmse_m"] == pytest.approx(late, rel=2e-3)
    assert [pair["limit"]["rmse_m"] for pair in made["pairs"]] == pytest.approx(
        [np.sqrt(np.mean(variance)) for variance in variances], rel=1e-6
    )
    assert "limit" in made["definitions"]
    print_document(path, made)
    output = capsys.readouterr().out
    assert "bound, m" in output
    assert f"{limit['kept_share']['0.02']:.0%} at 2% bad" in output


def test_bound_of_the_kept_share_assumes_gaussian_errors() -> None:
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.02, 0.4, (4000, 2))
    covariance = np.zeros((4000, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = sigma.T**2
    made = describe_limit([covariance], [covariance])
    bad = (np.hypot(*(rng.normal(size=(400, 4000, 2)) * sigma).T) > 0.3).mean(axis=1)
    mean = np.cumsum(np.sort(bad)) / np.arange(1, 4001)
    for share, kept in made["kept_share"].items():
        assert kept == pytest.approx(np.mean(mean <= float(share)), abs=0.01)
    assert 0.05 < made["kept_share"]["0.01"] < made["kept_share"]["0.02"] < 0.95
    assert made["rmse_m"] == pytest.approx(np.sqrt((sigma**2).sum(axis=1).mean()))


def test_a_part_of_a_flight_has_the_bound_of_its_own_ranges(tmp_path: Path) -> None:
    whole = _compute_limit(_write_flight(tmp_path / "whole.mcap"), 0.0)
    part = _compute_limit(_write_flight(tmp_path / "part.mcap", part_s=(8.0, 13.0)), 0.0)
    assert part["rmse_m"] > 1.2 * whole["rmse_m"]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {**asdict(SETTINGS), "noise": "ideal"},
        {**asdict(SETTINGS), "noise": "unheard of"},
        {**asdict(SETTINGS), "faults": [{"kind": "nlos"}]},
        {**asdict(SETTINGS), "duration_s": 3600.0},
        {**asdict(SETTINGS), "duration_s": "long"},
        {**asdict(SETTINGS), "robots": 20},
        {**asdict(SETTINGS), "trajectory": "unheard of"},
    ],
)
def test_flight_without_simulation_settings_has_no_bound(
    tmp_path: Path, settings: dict[str, Any]
) -> None:
    assert _compute_limit(_write_flight(tmp_path / "a.mcap", settings)) is None


def test_flight_simulated_by_another_version_has_no_bound_and_warns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _compute_limit(_write_flight(tmp_path / "moved.mcap", shift_m=0.01)) is None
    assert "simulates the flight otherwise" in capsys.readouterr().err
    other = asdict(replace(SETTINGS, seed=5))
    assert _compute_limit(_write_flight(tmp_path / "other.mcap", other)) is None
