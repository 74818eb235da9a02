"""Meaning of the columns of a foreign CSV file: a TOML file with one table per quantity.

::

    [time]
    name = "t"                      # the column
    unit = "s"
    [pitch]
    name = "att_stateEstimate_pitch"
    unit = "deg"
    sign = -1                       # logged positive nose up; dmrl has it positive nose down
    [vx]
    name = "est_stateEstimate_vx"
    unit = "m/s"
    frame = "world"                 # or horizontal, which turns with the robot, or body
    [height]
    value = 0.2                     # a constant, in place of a column
    unit = "m"
    [range.cf2]
    name = "uwb_2"
    unit = "mm"

One table serves several robots: ``{robot}`` in a name stands for the robot, and ``{peer}`` in the
name of ``[range."*"]`` for every peer. ``[robot] name`` is the column with the robot of each row,
``[peer] name`` that with the peer of each range. ``[file]`` states the form of the file; see
`dmrl.formats.files.text_table.Dialect`. ``[names]`` renames robots, as ``--names`` does.
``QUANTITIES`` lists the supported quantities.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from dmrl.errors import SourceError
from dmrl.formats.files.text_table import Dialect
from dmrl.guards.bounded_parsing import parse_toml

ANGLE_UNITS = {"rad": 1.0, "deg": 0.017453292519943295}
RATE_UNITS = {"rad/s": 1.0, "deg/s": 0.017453292519943295}
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
SPEED_UNITS = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3}
TIME_UNITS = {"s": 1_000_000_000.0, "ms": 1_000_000.0, "us": 1000.0, "ns": 1.0, "iso": 1e9}
NO_UNIT = {"1": 1.0}
FRAMES = ("world", "horizontal", "body")

QUANTITIES: dict[str, Mapping[str, float]] = {
    "time": TIME_UNITS,
    **dict.fromkeys(("roll", "pitch", "yaw"), ANGLE_UNITS),
    **dict.fromkeys(("yaw_rate", "gyro_y", "gyro_z"), RATE_UNITS),
    **dict.fromkeys(("vx", "vy", "vz"), SPEED_UNITS),
    **dict.fromkeys(("x", "y", "z", "height"), LENGTH_UNITS),
    **dict.fromkeys(("qx", "qy", "qz", "qw"), NO_UNIT),
    **dict.fromkeys(("true_x", "true_y", "true_z"), LENGTH_UNITS),
    **dict.fromkeys(("true_qx", "true_qy", "true_qz", "true_qw"), NO_UNIT),
}
"""Quantities and their units, each with its size in dmrl's unit (time: in nanoseconds)."""

REQUIRED_TOGETHER = (
    ("roll", "pitch"),
    ("vx", "vy"),
    ("x", "y", "z"),
    ("qx", "qy", "qz", "qw"),
    ("true_x", "true_y", "true_z"),
    ("true_qx", "true_qy", "true_qz", "true_qw"),
)
"""Groups of quantities that are only meaningful together."""
FORM_TABLES = ("robot", "peer", "file", "names")
"""Tables that are of no quantity."""
COLUMN_KEYS = ("name", "unit", "sign", "frame", "value", "held")
ANY_PEER = "*"
"""Key of the ranges to all peers that the names of columns tell."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of the file.

    Parameters
    ----------
    name
        Its name in the header; empty: the value is constant.
    scale
        Factor from its unit and sign to dmrl's.
    frame
        Frame of a velocity.
    unit
        Its unit.
    value
        Constant value, in its unit.
    held
        Whether the log holds the last value of a range; None: not stated.
    """

    name: str
    scale: float
    frame: str = ""
    unit: str = ""
    value: float | None = None
    held: bool | None = None


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """Columns by quantity, of ranges by peer, of robot and peer; form of the file, renames."""

    columns: Mapping[str, Column]
    ranges: Mapping[str, Column]
    robot_column: str = ""
    dialect: Dialect = field(default_factory=Dialect)
    renames: Mapping[str, str] = field(default_factory=dict)
    peer_column: str = ""

    @property
    def names(self) -> set[str]:
        """Names of all columns of the file that the map uses."""
        used = {column.name for column in (*self.columns.values(), *self.ranges.values())}
        return (used | {self.robot_column, self.peer_column}) - {""}


def read_column_map(path: Path, *, time_column: str = "") -> ColumnMap:
    """Read the column map from a TOML file.

    Parameters
    ----------
    path
        The file.
    time_column
        Column of nanoseconds that is the time if the file states none; empty: it must.

    Raises
    ------
    SourceError
        If the file is not TOML, or no valid map: names every error, in one line.
    """
    try:
        values = parse_toml(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as e:
        raise SourceError(f"{path} is no table of columns in TOML: {e}. Fix it") from None
    robot, peer, form, renames = (values.pop(key, {}) for key in FORM_TABLES)
    if time_column:
        values.setdefault("time", {"name": time_column, "unit": "ns"})
    ranges = values.pop("range", {})
    ranges = ranges if isinstance(ranges, dict) else {"": ranges}
    faults = [fault for key, table in values.items() for fault in _iter_errors(key, table)]
    faults += [f for peer, table in ranges.items() for f in _iter_errors(f"range.{peer}", table)]
    faults += [*_iter_missing(values), *_iter_form_errors(robot, peer, form)]
    faults += _iter_peer_errors(peer, ranges)
    if not isinstance(renames, dict) or not all(isinstance(new, str) for new in renames.values()):
        faults.append("[names]: not new names by old ones")
    if faults:
        raise SourceError(f"{path}: {'; '.join(faults)}. See docs/sources.md")
    columns = {key: _build_column(QUANTITIES[key], table) for key, table in values.items()}
    held = {peer: _build_column(LENGTH_UNITS, table) for peer, table in ranges.items()}
    return ColumnMap(
        columns, held, robot.get("name", ""), Dialect(**form), renames, peer.get("name", "")
    )


def _iter_peer_errors(peer: Any, ranges: Mapping[str, Any]) -> Iterator[str]:
    """Yield the errors of the ranges to any peer, which columns or rows name."""
    name = str(column.get("name", "")) if isinstance(column := ranges.get(ANY_PEER), dict) else ""
    if peer and [*ranges] != [ANY_PEER]:
        yield f'[peer] needs [range."{ANY_PEER}"], and no other range'
    elif peer and "{peer}" in name:
        yield f"[range.{ANY_PEER}] name: {{peer}} in it, but rows name the peer, by [peer]"
    elif name and not peer and "{peer}" not in name:
        yield (
            f"[range.{ANY_PEER}] name: no {{peer}} in it; the range to one peer is [range.PEER], "
            "and [peer] names a column of peers"
        )


def _iter_form_errors(robot: Any, peer: Any, form: Any) -> Iterator[str]:
    """Yield the errors of ``[robot]``, ``[peer]`` and ``[file]``."""
    for key, table, known in (
        ("robot", robot, ["name"]),
        ("peer", peer, ["name"]),
        ("file", form, [one.name for one in fields(Dialect)]),
    ):
        wrong = not isinstance(table, dict) or any(
            name not in known or not isinstance(value, str) for name, value in table.items()
        )
        if wrong:
            yield f"[{key}]: not texts for {', '.join(known)}"
    if isinstance(form, dict) and form.get("decimal", ".") not in (".", ","):
        yield '[file] decimal: not "." or ","'
    if isinstance(form, dict) and len(str(form.get("separator", ","))) != 1:
        yield "[file] separator: not one character"


def _iter_missing(values: Mapping[str, Any]) -> Iterator[str]:
    if "time" not in values:
        yield "no [time]"
    for group in REQUIRED_TOGETHER:
        given = [name for name in group if name in values]
        if given and len(given) < len(group):
            lacking = ", ".join(f"[{name}]" for name in group if name not in values)
            yield f"[{given[0]}] also needs {lacking}"
    frames = {v.get("frame", "") for k, v in values.items() if k[0] == "v" and isinstance(v, dict)}
    if len(frames) > 1:
        yield "velocities in several frames"
    if "height" in values and "z" in values:
        yield "[height] and [z] are the same quantity; remove one"


def _iter_errors(key: str, table: Any) -> Iterator[str]:
    """Yield the errors of a quantity's table."""
    units = LENGTH_UNITS if key.startswith("range.") else QUANTITIES.get(key)
    if units is None:
        near = get_close_matches(key, QUANTITIES, n=1)
        known = "there are " + ", ".join((*QUANTITIES, "range.PEER", *FORM_TABLES))
        known = f"did you mean {near[0]}?" if near else known
        yield f"[{key}]: no such quantity, {known}"
    elif not isinstance(table, dict):
        yield f"{key}: no table with name and unit"
    else:
        wrong = {name: "no such key" for name in table if name not in COLUMN_KEYS}
        wrong |= _find_wrong_values(units, table)
        yield from (f"[{key}] {name}: {what}" for name, what in wrong.items())


def _find_wrong_values(units: Mapping[str, float], table: Mapping[str, Any]) -> dict[str, str]:
    """Return the errors of the values of a quantity's table, by key."""
    wrong = {}
    name, unit, sign, frame, value, held = (table.get(key) for key in COLUMN_KEYS)
    if value is not None and (name is not None or units is TIME_UNITS or not _is_number(value)):
        wrong["value"] = "not a number in place of a name"
    elif value is None and not (isinstance(name, str) and name):
        wrong["name"] = "not the name of a column"
    if not isinstance(held, bool | None):
        wrong["held"] = "not true or false"
    has_unit = unit is not None or units is not NO_UNIT  # a plain number needs none
    if has_unit and unit not in tuple(units):
        wrong["unit"] = f"not one of {', '.join(units)}"
    if "sign" in table and (isinstance(sign, bool) or sign not in (1, -1)):
        wrong["sign"] = "not 1 or -1"
    if units is SPEED_UNITS and frame not in FRAMES:
        wrong["frame"] = f"not one of {', '.join(FRAMES)}"
    if units is not SPEED_UNITS and "frame" in table:
        wrong["frame"] = "for velocities only"
    return wrong


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _build_column(units: Mapping[str, float], table: Mapping[str, Any]) -> Column:
    scale = units[table.get("unit", "1")] * table.get("sign", 1)
    rest = {key: table[key] for key in ("frame", "unit", "value", "held") if key in table}
    return Column(table.get("name", ""), scale, **rest)
