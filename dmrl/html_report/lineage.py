"""Draw a graph of provenance: stages in columns, arrows in lanes that strike no box."""

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from itertools import pairwise

from dmrl.html_report.blocks import fill_template
from dmrl.recording import Input, Provenance

MAX_FILE_BOXES = 12
"""Source files with a box of their own; the others share one."""
Graph = tuple[list[list[str]], list[tuple[str, str]]]
"""Columns of boxes, and arrows between boxes."""
Slot = Hashable
"""A box, by its words, or a lane: the box that an arrow comes from, and the column it crosses."""
Route = list[tuple[int, Slot]]
"""Columns and slots of an arrow."""
BOX_PX, GAP_PX, ROW_PX, MARGIN_PX = (156, 28), 40, 40, 24
"""Width and height of a box, width between columns, height of a row, space around all."""
SWEEPS = 4
"""Passes over the columns that bring arrows closer to straight lines."""


def build_lineage(made: Mapping[str, Provenance]) -> Graph:
    """Build columns of boxes, from sources to results, and the arrows between them.

    A box stands for all outputs of one stage: "label x12". A stage whose inputs went through the
    same stage before has a box of its own: "label, round 2".

    Parameters
    ----------
    made
        Provenance of each output, by its name.
    """
    chain = _LineageBuilder()
    count = Counter(chain.add_box(one) for one in made.values())
    words = {box: f"{box} x{count[box]}" if count[box] > 1 else box for box in chain.depth}
    columns: list[list[str]] = [[] for _ in range(max(chain.depth.values(), default=-1) + 1)]
    for box, at in chain.depth.items():
        columns[at].append(words[box])
    return columns, [(words[source], words[result]) for source, result in chain.arrows]


class _LineageBuilder:
    """Boxes and arrows during the search, with the column of each box."""

    def __init__(self) -> None:
        self.depth: dict[str, int] = {}
        self.arrows: dict[tuple[str, str], None] = {}
        self._rounds: dict[str, Counter[str]] = {}  # by box: how often each stage ran before it
        self._known: dict[str, str] = {}  # the box of an input, by its hash

    def add_box(self, one: Provenance) -> str:
        """Return the box of an output; add it and the boxes of all its inputs."""
        inputs = [self._input_box(source) for source in one.inputs]
        rounds: Counter[str] = Counter()
        for box in inputs:
            rounds |= self._rounds[box]
        rounds[one.stage] += 1
        number = rounds[one.stage]
        name = one.stage if number == 1 else f"{one.stage}, round {number}"
        self._rounds[name] = self._rounds.get(name, Counter()) | rounds
        deep = [self.depth[box] + 1 for box in inputs]
        self.depth[name] = max([self.depth.get(name, 0), *deep])
        self.arrows.update(dict.fromkeys((box, name) for box in inputs if box != name))
        return name

    def _input_box(self, source: Input) -> str:
        if source.provenance is not None and source.sha256 not in self._known:
            self._known[source.sha256] = self.add_box(source.provenance)
        if source.sha256 in self._known:
            return self._known[source.sha256]
        files = sum(box.startswith("file ") for box in self.depth)
        box = f"file {source.name}" if files < MAX_FILE_BOXES else "more files"
        self.depth.setdefault(box, 0)
        self._rounds.setdefault(box, Counter())
        return box


def draw_lineage(made: Mapping[str, Provenance]) -> str:
    """Draw the graph of `build_lineage` as SVG; empty without outputs.

    An arrow over several columns has a lane of its own in each of them, a row without a box. It
    changes rows between the columns alone, so it strikes no box.
    """
    columns, arrows = build_lineage(made)
    place = {box: k for k, column in enumerate(columns) for box in column}
    routes = [_find_route(*arrow, place) for arrow in arrows]
    slots: list[list[Slot]] = [list(column) for column in columns]
    for k, slot in dict.fromkeys(one for route in routes for one in route[1:-1]):
        slots[k].append(slot)
    _order_slots(slots, routes)
    tallest = max(map(len, slots), default=0)
    middle_px = {
        slot: _find_middle(k, row, len(column), tallest)
        for k, column in enumerate(slots)
        for row, slot in enumerate(column)
    }
    paths = [
        _draw_path([middle_px[slot] for _, slot in route], forward=route[0][0] < route[-1][0])
        for route in routes
    ]
    size_px = (
        2 * MARGIN_PX + len(columns) * (BOX_PX[0] + GAP_PX) - GAP_PX,
        2 * MARGIN_PX + tallest * ROW_PX,
    )
    boxes = [(box, *middle_px[box]) for box in place]
    values = {"boxes": boxes, "paths": paths, "size_px": size_px, "box_px": BOX_PX}
    return fill_template("lineage.svg", **values) if columns else ""


def _find_route(source: str, result: str, place: Mapping[str, int]) -> Route:
    """Return the columns and slots of an arrow, from box to box."""
    first, last = place[source], place[result]
    # An arrow back has lanes in the columns of both boxes too.
    between = range(first + 1, last) if first < last else range(first, last - 1, -1)
    lanes = [(k, (source, k, first < last)) for k in between]
    return [(first, source), *lanes, (last, result)]


def _order_slots(slots: list[list[Slot]], routes: Sequence[Route]) -> None:
    """Order the slots of each column by the rows of their neighbours, in place."""
    beside: dict[Slot, set[tuple[int, Slot]]] = {}
    for route in routes:
        for one, other in pairwise(route):
            beside.setdefault(one[1], set()).add(other)
            beside.setdefault(other[1], set()).add(one)
    for sweep in range(SWEEPS):
        step = 1 if sweep % 2 else -1
        for k in range(len(slots))[::-step]:
            side = slots[k + step] if 0 <= k + step < len(slots) else []
            rows, level = {slot: row for row, slot in enumerate(side)}, {}
            for row, slot in enumerate(slots[k]):
                near = [rows[other] for _, other in beside.get(slot, ()) if other in rows]
                level[slot] = sum(near) / len(near) if near else row
            slots[k].sort(key=level.__getitem__)


def _find_middle(column: int, row: int, rows: int, tallest: int) -> tuple[float, float]:
    x = MARGIN_PX + BOX_PX[0] / 2 + column * (BOX_PX[0] + GAP_PX)
    return x, MARGIN_PX + ROW_PX * (row + (tallest - rows + 1) / 2)


def _draw_path(middles: Sequence[tuple[float, float]], *, forward: bool) -> str:
    """Return the SVG path from box to box: curves between columns, lines across lanes.

    It leaves its first box at the right and enters its last at the left.
    """
    half, bend, last = BOX_PX[0] / 2, GAP_PX / 2, len(middles) - 2
    words = []
    for k, ((x0, y0), (x1, y1)) in enumerate(pairwise(middles)):
        out, into = (1 if forward or k == 0 else -1), (-1 if forward or k == last else 1)
        start, end = x0 + out * half, x1 + into * half
        curve = f"{start + out * bend:g},{y0:g} {end + into * bend:g},{y1:g} {end:g},{y1:g}"
        words.append(f"{'L' if k else 'M'}{start:g},{y0:g} C{curve}")
    return " ".join(words)
