"""Layout of the unknowns of a problem: columns, priors and subjects, derived from the table."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.unknowns import SIGHTED, Owner, Unknown

Subject = tuple[str, tuple[int, ...]]
"""Name of an unknown, and the indices of its robots."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Columns of a flight's unknowns, derived from a table.

    Parameters
    ----------
    robots
        Number of robots N. A keyframe begins with x, y, theta of each.
    states, constants
        Subject and row of every further column of a keyframe, and of every constant.
    """

    robots: int
    states: tuple[tuple[Subject, Unknown], ...]
    constants: tuple[tuple[Subject, Unknown], ...]

    @property
    def width(self) -> int:
        """Number of columns of a keyframe."""
        return 3 * self.robots + len(self.states)

    def subjects(self) -> dict[Subject, int]:
        """Return the columns of all unknowns; constants follow the keyframe's."""
        poses = [("pose", (robot, k)) for robot in range(self.robots) for k in range(3)]
        others = [subject for subject, _ in (*self.states, *self.constants)]
        return {subject: column for column, subject in enumerate([*poses, *others])}

    def pose(self, robot: int) -> list[int]:
        """Return the columns of a robot's pose."""
        return [3 * robot, 3 * robot + 1, 3 * robot + 2]

    def find(self, name: str, *robots: int) -> int:
        """Return the index of a constant.

        Raises
        ------
        KeyError
            If the flight has no such constant.
        """
        return {subject: k for k, (subject, _) in enumerate(self.constants)}[name, robots]

    def state_column(self, name: str, *robots: int) -> int | None:
        """Return the column of a state; None if the flight has none."""
        for k, (subject, _) in enumerate(self.states):
            if subject == (name, robots):
                return 3 * self.robots + k
        return None

    def of(self, *robots: int) -> Iterator[tuple[Unknown, int, bool]]:
        """Yield row, column and whether it is a constant, of the unknowns that robots own."""
        for k, ((_, own), row) in enumerate(self.states):
            if own in (robots, ()):
                yield row, 3 * self.robots + k, False
        for k, ((_, own), row) in enumerate(self.constants):
            if own in (robots, ()):
                yield row, k, True

    def measured(
        self, both: tuple[int, int], kind: Literal["range", "bearing", "height"]
    ) -> list[tuple[Unknown, int, bool, float]]:
        """Return the unknowns of a measurement between two robots.

        Parameters
        ----------
        both
            Observer and peer.
        kind
            Kind of the measurement. Ranges and bearings depend on heights too.

        Returns
        -------
        list
            Row, column, whether it is a constant, and the sign of its effect on the height
            difference: measured heights exceed true ones by the error.
        """
        found = []
        for owners, side in (((both[0],), 1.0), ((both[1],), -1.0), (tuple(sorted(both)), 1.0)):
            for row, column, constant in self.of(*owners):
                if row.owner == "flight" and owners != (both[0],):
                    continue
                of_range = kind == "range" and (row.range or row.range_power)
                # A camera's own errors are those of the observer.
                of_bearing = kind == "bearing" and row.bearing and owners == (both[0],)
                if row.height or of_range or of_bearing:
                    found.append((row, column, constant, side))
        return found


def build_layout(
    table: tuple[Unknown, ...],
    robots: int,
    links: Collection[tuple[int, int]],
    sighted: Collection[int] = (),
    unused: Collection[Subject] = (),
) -> Layout:
    """Build the columns of a flight.

    Parameters
    ----------
    table
        Rows of the unknowns.
    robots
        Number of robots.
    links
        Pairs of robots with ranges.
    sighted
        Robots with detections by or of them.
    unused
        Unknowns that the flight does not need.
    """
    owners: Mapping[Owner, list[tuple[int, ...]]] = {
        "robot": [(k,) for k in range(robots)],
        "clock": [(k,) for k in range(1, robots)],
        "antenna": [(k,) for k in range(robots)],
        "pair": [tuple(link) for link in links],
        "flight": [()],
    }
    every = [
        ((row.name, own), row)
        for row in table
        for own in owners[row.owner]
        if (row.name not in SIGHTED or own[0] in sighted) and (row.name, own) not in unused
    ]
    return Layout(
        robots,
        tuple(one for one in every if not one[1].is_constant),
        tuple(one for one in every if one[1].is_constant),
    )


def from_peer(layout: Layout, values: Array) -> Array:
    """Return the constants (G,) of a pair with observer and peer exchanged."""
    out = np.empty_like(values)
    for k, ((name, own), row) in enumerate(layout.constants):
        other = own if row.owner in ("pair", "clock", "flight") else (1 - own[0],)
        out[layout.find(name, *other)] = -values[k] if row.negated else values[k]
    return out
