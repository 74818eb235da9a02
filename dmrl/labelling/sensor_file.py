"""Sensor errors that are constant over many flights, and their TOML file.

``dmrl calibrate --sensors`` writes it. ``dmrl label --sensors`` removes the means from the logs and
takes the standard deviations as priors of the solve.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from dmrl.errors import SourceError
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.layout import Subject
from dmrl.estimation.solver.unknowns import TABLE
from dmrl.guards.bounded_parsing import parse_toml
from dmrl.guards.paths import refuse_pipe

Names = tuple[str, str]
Value = tuple[float, float]
"""A mean over flights, and the standard deviation of the next flight about it."""
Values = Mapping[str, Value]

OF_ROBOT, OF_PAIR = (
    {row.key: row.name for row in TABLE if row.key and row.owner == owner}
    for owner in ("robot", "pair")
)
"""Names of the unknowns of a robot and of a pair, by their keys in the file."""
SCALES = tuple(row.key for row in TABLE if row.key and row.unit == "1")
MAX_MEAN, MAX_SCALE_MEAN = 60.0, 0.9
"""Largest mean of a constant, and of a scale."""
HEAD = """\
# What flights agree on, for dmrl label --sensors: [mean, standard deviation of the next flight].
# Logs show a velocity (1 + velocity_scale) v + bias and a range (1 + range_scale) d + offset.
"""


@dataclass(frozen=True, slots=True)
class SensorConstants:
    """Constant errors of sensors, by robot and by pair of robots.

    Parameters
    ----------
    robots
        By name: values under the keys of `OF_ROBOT`, or some of them.
    pairs
        By both names in their order: values under the keys of `OF_PAIR`, or some of them.
    """

    robots: Mapping[str, Values] = field(default_factory=dict)
    pairs: Mapping[Names, Values] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Return the robots that have any constant."""
        return sorted({*self.robots, *(name for pair in self.pairs for name in pair)})

    def correct_yaw_rate(self, robot: str, logged: Array) -> Array:
        """Remove the bias of yaw rates, rad/s."""
        return logged - _get_mean(self.robots.get(robot, {}), "yaw_rate_bias_radps")

    def correct_velocity(self, robot: str, logged: Array) -> Array:
        """Remove bias and scale of (N, 2) velocities, m/s."""
        known = self.robots.get(robot, {})
        bias = [_get_mean(known, "vx_bias_mps"), _get_mean(known, "vy_bias_mps")]
        return np.asarray((logged - bias) / (1 + _get_mean(known, "velocity_scale")))

    def correct_ranges(self, pair: Names, measured: Array) -> Array:
        """Remove offset and scale of ranges, metres."""
        known = self.pairs.get(pair, {})
        longer_m = _get_mean(known, "range_offset_m")
        return np.asarray((measured - longer_m) / (1 + _get_mean(known, "range_scale")))

    def to_prior_std(self, pair: Names) -> dict[Subject, float]:
        """Return the prior standard deviations of a pair's known constants."""
        out: dict[Subject, float] = {}
        for side, robot in enumerate(pair):
            for key, value in self.robots.get(robot, {}).items():
                out[OF_ROBOT[key], (side,)] = value[1]
        for key, value in self.pairs.get(pair, {}).items():
            out[OF_PAIR[key], (0, 1)] = value[1]
        return out


def _get_mean(known: Values, key: str) -> float:
    return known.get(key, (0.0, 0.0))[0]


def write_sensors(sensors: SensorConstants) -> str:
    """Write the TOML document that `read_sensors` reads."""
    robots = [{"name": name, **_round_values(v)} for name, v in sensors.robots.items()]
    pairs = [{"robots": list(names), **_round_values(v)} for names, v in sensors.pairs.items()]
    return HEAD + tomli_w.dumps({"robots": robots, "pairs": pairs})


def _round_values(values: Values) -> dict[str, list[float]]:
    return {key: [float(f"{part:.6g}") for part in value] for key, value in values.items()}


def read_sensors(path: Path) -> SensorConstants:
    """Read a TOML file of sensor constants.

    Raises
    ------
    SourceError
        If there is no such file, or `write_sensors` did not write it.
    """
    refuse_pipe(path)
    try:
        table = parse_toml(path.read_text(encoding="utf-8"))
        if wrong := set(table) - {"robots", "pairs"}:
            raise ValueError(f"it has {min(wrong)}, and not robots and pairs alone")
        robots = {
            _read_name(one): _read_values(one, "name", OF_ROBOT)
            for one in _read_tables(table, "robots")
        }
        pairs = {
            _read_names(one): _read_values(one, "robots", OF_PAIR)
            for one in _read_tables(table, "pairs")
        }
    except FileNotFoundError:
        raise SourceError(f"no file {path}. Write one: dmrl calibrate --sensors") from None
    except (OSError, ValueError) as e:
        raise SourceError(f"{path}: {e}. Write one: dmrl calibrate --sensors") from None
    return SensorConstants(robots, pairs)


def _read_tables(table: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    found = table.get(key, [])
    if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
        raise ValueError(f"{key} is no list of tables [[{key}]]")
    return found


def _read_name(one: Mapping[str, Any]) -> str:
    if not isinstance(name := one.get("name"), str):
        raise ValueError("a table of robots has no name")
    return name


def _read_names(one: Mapping[str, Any]) -> Names:
    found = one.get("robots")
    if not isinstance(found, list) or len(found) != 2 or not all(isinstance(n, str) for n in found):
        raise ValueError('a table of pairs has no robots = ["one", "other"]')
    if not found[0] < found[1]:
        raise ValueError(f"the robots {', '.join(found)} are not two in the order of their names")
    return found[0], found[1]


def _read_values(one: Mapping[str, Any], name: str, known: Mapping[str, Any]) -> Values:
    given = {key: value for key, value in one.items() if key != name}
    for key, value in given.items():
        if key not in known:
            raise ValueError(f"{key} is none of {', '.join(known)}")
        if not _is_value(value) or abs(value[0]) > (MAX_SCALE_MEAN if key in SCALES else MAX_MEAN):
            raise ValueError(f"{key} is no [mean, standard deviation] of a sensor")
    return {key: (float(value[0]), float(value[1])) for key, value in given.items()}


def _is_value(value: object) -> bool:
    if not isinstance(value, list) or len(value) != 2:
        return False
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    return numbers and all(map(np.isfinite, value)) and value[1] > 0
