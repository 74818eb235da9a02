"""A flight in CSV whose robot has a range to itself: a file or a column has the wrong name."""

from pathlib import Path

from dmrl.formats.files import flight_csv
from dmrl.terminal.left_out import count_left_out

TEXT = """time_s,roll_rad,pitch_rad,yaw_rate_radps,vx_mps,vy_mps,height_m,range_cf2_m
1.0,0,0,0,0,0,1,2.5
1.1,0,0,0,0,0,1,2.6
"""


def test_a_robot_has_no_range_to_itself(tmp_path: Path) -> None:
    (tmp_path / "cf2.csv").write_text(TEXT)
    with count_left_out() as left:
        found = {s.topic for s in flight_csv.load_content(tmp_path).samples}
    assert "/cf2/height" in found and "/cf2/range/cf2" not in found
    assert left.counts == {"ranges of cf2 to itself": 2}
