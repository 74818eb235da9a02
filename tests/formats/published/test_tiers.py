"""Published ranges of TIERS become ranges, odometry and true positions."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.published import tiers


@pytest.fixture
def ranges(tmp_path: Path) -> Path:
    """Write ranges of two robots; the first moves along x at 1 m/s and faces along y.

    One of the ranges is 0, hence missing.
    """
    path = tmp_path / "two.npz"
    along = np.arange(10) * 0.1
    still = np.zeros(10)
    np.savez(
        path,
        uwb_range_3_1_np=np.array([2.0, 0.0, *[2.5] * 8]),
        optitrack_turtle01_pose_np=np.stack([along, still], axis=1),
        optitrack_turtle01_orientation_np=still + np.pi / 2,
        optitrack_turtle03_pose_np=np.stack([still, still + 2], axis=1),
        optitrack_turtle03_orientation_np=still,
    )
    return path


def test_ranges_odometry_and_truth_come_out(ranges: Path) -> None:
    assert tiers.can_read(ranges)
    samples = list(tiers.load_content(ranges).samples)
    times = [s.time_ns for s in samples]
    assert times == sorted(times)
    measured = [s for s in samples if s.topic == "/turtle3/range/turtle1"]
    assert [s.time_ns for s in measured] == [0, *(k * 10**8 for k in range(2, 10))]
    speed = [s.fields for s in samples if s.topic == "/turtle1/velocity"]
    assert np.allclose([(f["vx_mps"], f["vy_mps"]) for f in speed], (0.0, -1.0))
    seen = [s.fields for s in samples if s.topic == "/turtle1/peer/turtle3/truth"]
    assert (seen[0]["x"], seen[0]["y"]) == pytest.approx((2.0, 0.0))
    assert (seen[-1]["x"], seen[-1]["y"]) == pytest.approx((2.0, 0.9))
    back = [s.fields for s in samples if s.topic == "/turtle3/peer/turtle1/truth"]
    assert (back[-1]["x"], back[-1]["y"], back[-1]["z"]) == pytest.approx((0.9, -2.0, 0.0))
    assert not [s for s in samples if s.topic == "/turtle1/peer/turtle1/truth"]


def test_other_files_are_refused(ranges: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.npz"
    np.savez(other, speed=np.zeros(3))
    assert not tiers.can_read(other)
    with pytest.raises(SourceError, match="has no uwb_range"):
        tiers.load_content(other)
    odd = tmp_path / "odd.npz"
    with np.load(ranges) as archive:
        arrays = dict(archive)
    np.savez(odd, **{**arrays, "uwb_range_3_1_np": np.zeros(4)})
    with pytest.raises(SourceError, match="differ in length"):
        tiers.load_content(odd)
    cut = tmp_path / "cut.npz"
    cut.write_bytes(ranges.read_bytes()[:-100])
    assert not tiers.can_read(cut)


@pytest.mark.heavy
def test_the_public_file_reads(data: Path) -> None:
    samples = list(tiers.load_content(data / "uwb-tiers" / "4robots_data_01.npz").samples)
    ranged = {s.topic for s in samples if s.message == "UwbRange"}
    assert len(ranged) == 6
    assert "/turtle5/range/turtle1" in ranged
    assert max(s.time_ns for s in samples) == 150_700_000_000


@pytest.mark.parametrize(
    "arrays",
    [
        {"uwb_range_1_2_np": np.zeros((9, 2)), "optitrack_turtle1_pose_np": np.zeros((9, 2))},
        {"uwb_range_1_2_np": np.float64(1), "optitrack_turtle1_pose_np": np.zeros((9, 2))},
        {f"optitrack_turtle{'1' * 5000}_pose_np": np.zeros((9, 2)), "uwb_range_1_2_np": np.ones(9)},
        {
            **{f"optitrack_turtle{k}_pose_np": np.zeros((9, 2)) for k in range(65)},
            "uwb_range_1_2_np": np.ones(9),
        },
    ],
)
def test_arrays_of_strange_shapes_and_numbers_give_one_line_errors(
    tmp_path: Path, arrays: dict[str, Any]
) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, **arrays)
    strange = np.ndim(arrays["uwb_range_1_2_np"]) != 1
    with pytest.raises(SourceError, match="arrays of wrong shapes" if strange else None):
        tiers.load_content(path)


@pytest.mark.parametrize("kind", ["f4", "f8", "i4"])
def test_numbers_of_any_width_are_read(kind: str, ranges: Path) -> None:
    with np.load(ranges) as archive:
        np.savez(ranges, **{name: np.ceil(archive[name]).astype(kind) for name in archive})
    found = [s for s in tiers.load_content(ranges).samples if s.message == "UwbRange"]
    assert [s.fields["range_m"] for s in found] == [2.0] + [3.0] * 8


@pytest.mark.parametrize("shape", [(10, 3), (10, 1), (10,), (9, 2)])
def test_poses_are_pairs_of_numbers(shape: tuple[int, ...], ranges: Path) -> None:
    with np.load(ranges) as archive:
        arrays = dict(archive)
    np.savez(ranges, **{**arrays, "optitrack_turtle01_pose_np": np.zeros(shape)})
    with pytest.raises(SourceError, match="the arrays of turtle01 differ in length"):
        tiers.load_content(ranges)


@pytest.mark.parametrize(("robots", "fits"), [(64, True), (65, False)])
@pytest.mark.heavy
def test_sixty_four_robots_are_the_most(robots: int, fits: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    poses = {f"optitrack_turtle{k}_pose_np": np.zeros((2, 2)) for k in range(robots)}
    turns = {f"optitrack_turtle{k}_orientation_np": np.zeros(2) for k in range(robots)}
    np.savez(path, **poses, **turns, uwb_range_1_2_np=np.ones(2))
    if fits:
        assert tiers.load_content(path).total is None
    else:
        with pytest.raises(SourceError, match="has more than 64 robots"):
            tiers.load_content(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.0])
def test_invalid_range_is_omitted(value: float, ranges: Path) -> None:
    with np.load(ranges) as archive:
        arrays = dict(archive)
    arrays["uwb_range_3_1_np"][4] = value
    np.savez(ranges, **arrays)
    found = [s for s in tiers.load_content(ranges).samples if s.message == "UwbRange"]
    assert [s.time_ns // 10**8 for s in found] == [0, 2, 3, *range(5, 10)]
