"""Column maps of CSV files: units and errors."""

from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.files.column_map import QUANTITIES, read_column_map

from .test_mapped_csv import TABLE


def test_every_fault_of_a_table_is_named_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text(
        dedent("""
        rate = 5
        [rol]
        name = "phi"
        [pitch]
        name = 5
        unit = "degrees"
        sign = 2
        colour = "red"
        [vx]
        name = "vx"
        unit = "m/s"
        frame = "earth"
        [height]
        name = "h"
        unit = "m"
        frame = "world"
        [range.cf2]
        name = "d"
        unit = "s"
        """)
    )
    with pytest.raises(SourceError) as e:
        read_column_map(path)
    text = str(e.value)
    assert "\n" not in text and "map.toml" in text
    for fault in (
        "[rate]: no such quantity",
        "[rol]: no such quantity, did you mean roll?",
        "[pitch] name: not the name of a column",
        "[pitch] unit: not one of rad, deg",
        "[pitch] sign: not 1 or -1",
        "[pitch] colour: no such key",
        "[vx] frame: not one of world, horizontal, body",
        "[height] frame: for velocities only",
        "[range.cf2] unit: not one of m, cm, mm",
        "no [time]",
        "[vx] also needs [vy]",
        "[pitch] also needs [roll]",
    ):
        assert fault in text


@pytest.mark.parametrize("text", ["time = ", "range = 5\n", "time = 5\n", "vx = 5\n"])
def test_invalid_column_map_gives_one_line_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(SourceError, match=r"map\.toml"):
        read_column_map(tmp_path / "map.toml")


def test_units_have_their_conversion_factor() -> None:
    degree = np.pi / 180
    for quantity, units in {
        "yaw": {"rad": 1, "deg": degree},
        "gyro_z": {"rad/s": 1, "deg/s": degree},
        "height": {"m": 1, "cm": 0.01, "mm": 0.001},
        "vx": {"m/s": 1, "cm/s": 0.01, "mm/s": 0.001},
        "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1, "iso": 1e9},
        "qw": {"1": 1},
    }.items():
        assert QUANTITIES[quantity] == pytest.approx(units)


@pytest.mark.parametrize(
    ("was", "now", "fault"),
    [
        ('name = "phi"', 'name = ""', "[roll] name: not the name of a column"),
        ('name = "phi"', "name = 5", "[roll] name: not the name of a column"),
        ("sign = -1", "sign = true", "[pitch] sign: not 1 or -1"),
        ("sign = -1", "sign = 0", "[pitch] sign: not 1 or -1"),
        ('unit = "deg/s"', 'unit = "deg"', "[yaw_rate] unit: not one of rad/s, deg/s"),
        (
            '[vy]\nname = "vy"\nunit = "cm/s"\nframe = "world"',
            '[vy]\nname = "vy"\nunit = "cm/s"\nframe = "body"',
            "velocities in several frames",
        ),
        ("[height]", '[z]\nname = "h"\nunit = "m"\n[height]', "remove one"),
        ("[range.cf2]", "[range.cf2]\nsign = 2", "[range.cf2] sign: not 1 or -1"),
    ],
)
def test_single_fault_of_a_column_map_is_reported_alone(
    was: str, now: str, fault: str, tmp_path: Path
) -> None:
    path = tmp_path / "map.toml"
    path.write_text(TABLE)
    read_column_map(path)
    assert was in TABLE
    path.write_text(TABLE.replace(was, now, 1))
    with pytest.raises(SourceError) as e:
        read_column_map(path)
    assert fault in str(e.value)
