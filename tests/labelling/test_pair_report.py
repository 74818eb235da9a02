"""The report of a pair: its figures, causes and remedies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl import topics
from dmrl.estimation.evidence.error_models import MODELS
from dmrl.estimation.model.gate import Gate
from dmrl.estimation.solver.estimate import PAIR_LAYOUT, REASONS, Cause, Estimate
from dmrl.labelling.flight_log import read_flight
from dmrl.labelling.pair_report import REMEDIES, PairCause, PairReport, explain_causes, report_pair
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK, STATUS_UNCONVERGED, message_class
from dmrl.recording import Provenance, RecordingWriter

SECOND_NS = 1_000_000_000
STATUS = [STATUS_OK, STATUS_OK, STATUS_AMBIGUOUS, STATUS_UNCONVERGED, STATUS_OK]
OFF_M = [(0.3, 0.4), (0.0, 0.0), (3.0, 4.0), (0.0, 1.0), (9.0, 9.0)]


def build_positions() -> PeerPositions:
    """Return positions with errors OFF_M; the last one is after the end of the truth."""
    time_ns = np.array([1, 2, 3, 4, 60]) * SECOND_NS // 2
    true = np.column_stack([time_ns / SECOND_NS, np.zeros(5), np.ones(5)])
    xyz = true + np.column_stack([OFF_M, np.full(5, 7.0)])
    spread = [np.diag([0.01, 0.04, 9.0])] * 4 + [np.diag([0.25, 0.01, 9.0])]
    return PeerPositions(time_ns, xyz, np.array(spread), np.array(STATUS, np.int8))


def build_estimate() -> Estimate:
    """Return an estimate with known constants and two probable causes of errors."""
    constants = np.zeros(len(PAIR_LAYOUT.constants))
    for value, name, *own in ((0.35, "range_offset", 0, 1), (0.02, "gyro_bias", 0)):
        constants[PAIR_LAYOUT.find(name, *own)] = value
    constants[PAIR_LAYOUT.find("gyro_bias", 1)] = 0.05
    made = object.__new__(Estimate)
    object.__setattr__(made, "constants", constants)
    object.__setattr__(made, "layout", PAIR_LAYOUT)
    causes = (Cause("yaw rate bias", 0.9, 1.0, 2.0, 1), Cause("range offset", 0.3, 1.0, 2.0))
    object.__setattr__(made, "causes", causes)
    return made


def write_truth(path: Path, truth_s: list[float]) -> Path:
    """Write true positions whose x, in metres, is the time in seconds."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for moment in truth_s:
            at = message_class("PeerPosition")(x=moment, y=0.0, z=1.0)
            sink.write(round(moment * SECOND_NS), topics.TRUTH("cf1", "cf2"), at)
    return path


def build_report(path: Path) -> PairReport:
    """Report the pair of cf1 and cf2 from its positions and estimate."""
    return report_pair(read_flight(path), ("cf1", "cf2"), build_positions(), build_estimate())


def test_pair_report_has_sigma_shares_and_rmse(tmp_path: Path) -> None:
    got = build_report(write_truth(tmp_path / "a.mcap", np.arange(0, 4.1, 0.5).tolist()))
    assert (got.robot, got.peer, got.positions) == ("cf1", "cf2", 5)
    assert (got.kept_share, got.ambiguous_share) == pytest.approx((0.6, 0.2))
    assert got.range_bias_m == pytest.approx(0.35)
    assert got.sigma_m == pytest.approx(0.2)
    assert got.rmse_ok_m == pytest.approx(np.sqrt((0.25 + 0) / 2))
    assert got.rmse_m == pytest.approx(np.sqrt((0.25 + 0 + 25 + 1) / 4))


def test_without_truth_there_is_no_error(tmp_path: Path) -> None:
    for name, times_s in (("a.mcap", []), ("b.mcap", [0.5])):
        got = build_report(write_truth(tmp_path / name, times_s))
        assert (got.rmse_ok_m, got.rmse_m) == (None, None)


def test_report_columns_match_their_headers(tmp_path: Path) -> None:
    got = build_report(write_truth(tmp_path / "a.mcap", [0.0, 4.0]))
    cells = dict(zip(got.columns(), got.row(), strict=True))
    assert cells["range bias, m"] == "0.35"
    assert (cells["kept"], cells["ambiguous"]) == ("60.0%", "20.0%")
    unknown = build_report(write_truth(tmp_path / "b.mcap", []))
    assert dict(zip(got.columns(), unknown.row(), strict=True))["RMSE, m"] == "-"


def test_probable_causes_name_the_robot_and_a_remedy(tmp_path: Path) -> None:
    got = build_report(write_truth(tmp_path / "a.mcap", [0.0, 4.0]))
    assert [(cause.name, cause.robot) for cause in got.causes] == [
        ("yaw rate bias", "cf2"),
        ("range offset", None),
    ]
    assert got.row()[-1] == "cf2's yaw rate bias"
    (line,) = explain_causes([got, got])
    assert line.startswith("cf1-cf2: cf2's yaw rate bias (90%, 1 to 2 s). Let its gyroscope settle")


def test_every_cause_has_a_remedy() -> None:
    names = [model.name for model in MODELS] + list(REASONS.values())
    assert all(any(map(name.startswith, REMEDIES)) for name in names)


def test_a_remedy_fits_the_error_and_not_only_the_sensor() -> None:
    def remedy(name: str) -> str:
        return str(PairCause(name, 1.0, 0.0, 9.0, "cf1"))

    assert "signs and frames" in remedy("sensors are silent")
    assert "height" in remedy("flow scale") and "height" in remedy("flow scale changes")
    assert all("delay" in remedy(f"{name} late") for name in ("flow", "yaw rate"))
    others = [m.name for m in MODELS if m.name.startswith("flow") and "scale" not in m.name]
    assert not [name for name in others if "height" in remedy(name).replace(name, "")]


def test_imprecise_positions_come_with_the_numbers_of_the_gate(tmp_path: Path) -> None:
    got = build_report(write_truth(tmp_path / "a.mcap", [0.0, 4.0]))
    imprecise = PairCause(REASONS["imprecise"], 1.0, 0.0, 9.0, None)
    both = [replace(got, causes=[imprecise]), replace(got, sigma_m=0.3, causes=[imprecise])]
    (line,) = explain_causes(both, Gate(0.25, 0.05))
    assert all(words in line for words in ("0.20 m", "5% (--bad-share)", "0.25 m (--gate-m)"))


def test_a_cause_of_many_pairs_has_one_line(tmp_path: Path) -> None:
    got = build_report(write_truth(tmp_path / "a.mcap", [0.0, 4.0]))
    reports = [
        replace(
            got,
            peer=f"cf{k}",
            sigma_m=0.1 * k,
            causes=[PairCause(REASONS["imprecise"], 0.1 * k, float(k), 20.0 - k, None)],
        )
        for k in range(3, 8)
    ]
    assert len(explain_causes(reports[:-1])) == 2  # two causes are probable
    (line,) = explain_causes([*reports, replace(got, peer="cf8", causes=reports[-1].causes)])
    assert line.startswith("4 pairs (cf1-cf5, cf1-cf6, cf1-cf7, ...): positions are imprecise")
    assert "(70%, 5 to 15 s)" in line and "median sigma of 0.20 to 0.70 m" in line
