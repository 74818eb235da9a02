"""Build a graph from provenance: stages in columns, each to the right of its inputs."""

from collections import Counter
from collections.abc import Mapping

from dmrl.recording import Input, Provenance

MAX_FILE_BOXES = 12
"""Source files with a box of their own; the others share one."""
Graph = tuple[list[list[str]], list[tuple[str, str]]]
"""Columns of boxes, and arrows between boxes."""


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
