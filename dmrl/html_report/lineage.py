"""Provenance as a graph: kinds of outputs in columns, each after what it was made from."""

from collections import Counter
from collections.abc import Mapping

from dmrl.recording import Input, Provenance

MOST_FILES = 12
"""Sources that get a box of their own; the rest shares one."""
Graph = tuple[list[list[str]], list[tuple[str, str]]]


def ancestry(made: Mapping[str, Provenance]) -> Graph:
    """Columns of boxes, from sources to results, and the arrows between them.

    A box is what one stage made, however many outputs that are: "label x12". What a stage made of
    what had gone through it before is a box of its own: "label, round 2".

    Parameters
    ----------
    made
        How each output was made, by its name.
    """
    chain = _Chain()
    count = Counter(chain.box(one) for one in made.values())
    words = {box: f"{box} x{count[box]}" if count[box] > 1 else box for box in chain.depth}
    columns: list[list[str]] = [[] for _ in range(max(chain.depth.values(), default=-1) + 1)]
    for box, at in chain.depth.items():
        columns[at].append(words[box])
    return columns, [(words[source], words[result]) for source, result in chain.arrows]


class _Chain:
    """Boxes while they are found: how deep each lies, and what leads to it."""

    def __init__(self) -> None:
        self.depth: dict[str, int] = {}
        self.arrows: dict[tuple[str, str], None] = {}
        self._rounds: dict[str, Counter[str]] = {}  # of every stage, on the way to a box
        self._known: dict[str, str] = {}  # the box of an input, by its hash

    def box(self, one: Provenance) -> str:
        """The box of an output, and those of all that it was made from."""
        inputs = [self._input(source) for source in one.inputs]
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

    def _input(self, source: Input) -> str:
        if source.provenance is not None and source.sha256 not in self._known:
            self._known[source.sha256] = self.box(source.provenance)
        if source.sha256 in self._known:
            return self._known[source.sha256]
        files = sum(box.startswith("file ") for box in self.depth)
        box = f"file {source.name}" if files < MOST_FILES else "more files"
        self.depth.setdefault(box, 0)
        self._rounds.setdefault(box, Counter())
        return box
