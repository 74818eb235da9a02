"""New names of robots that match no robot, or two robots, are reported."""

from pathlib import Path

import pytest

from dmrl.errors import SettingError
from dmrl.stages.convert import Settings, run

TABLE = """
[time]
name = "t"
unit = "s"
[height]
name = "h"
unit = "m"
[range."*"]
name = "to_{peer}"
unit = "m"
"""
OWN = "time_s,roll_rad,pitch_rad,yaw_rate_radps,vx_mps,vy_mps,height_m\n"


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Return a folder with the logs of two robots; their column map is beside it."""
    (tmp_path / "map.toml").write_text(TABLE)
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in ("cf1", "cf3"):
        (folder / f"{name}.csv").write_text("t,h,to_cf2\n0,1,2\n0.1,1,2.1\n")
    return folder


def test_two_robots_cannot_get_one_name(logs: Path) -> None:
    out, table = logs.with_name("out.mcap"), logs.with_name("map.toml")
    with pytest.raises(SettingError, match=r"two robots .* /cf3/.*--names"):
        run(logs, out, Settings(columns=table, names="cf1=cf3"))
    run(logs, out, Settings(columns=table, names="cf1=cf3,cf3=cf1"))


def test_two_robots_of_flight_logs_cannot_get_one_name(tmp_path: Path) -> None:
    for name in ("cf1", "cf3"):
        (tmp_path / f"{name}.csv").write_text(f"{OWN}0,0,0,0,0,0,1\n0.1,0,0,0,0,0,1\n")
    with pytest.raises(SettingError, match="two robots"):
        run(tmp_path, tmp_path / "out.mcap", Settings(names="cf1=cf3"))


def test_names_of_no_robot_of_the_source_are_reported(
    logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, table = logs.with_name("out.mcap"), logs.with_name("map.toml")
    with pytest.raises(SettingError, match=r"--names has no effect: .*logs has no cf7"):
        run(logs, out, Settings(columns=table, names="cf7=red"))
    assert not out.exists()
    run(logs, out, Settings(columns=table, names="cf7=red,cf2=blue"))
    assert "--names has names that are not in it: cf7" in capsys.readouterr().err
