"""Where a recording, dataset or model comes from: stage, settings, seed, inputs, libraries.

Each input carries its own provenance, so one output tells its whole ancestry. An ancestor that
many inputs share, such as the model that labelled all of a hundred flights, is told once, where it
first comes: told each time, three rounds of labels over fifty flights were 300 MB of text.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import tomli_w

from dmrl import __version__
from dmrl.guards import limits
from dmrl.guards.bounded_parsing import parse_json

FILE_NAME = "provenance.json"
METADATA_NAME = "dmrl.provenance"


@dataclass(frozen=True, slots=True)
class Input:
    """One input of a stage.

    Parameters
    ----------
    name
        File or folder name, without its path: outputs do not depend on where inputs lay.
    sha256
        Of the file, or of a folder's sorted names and contents.
    provenance
        Its own provenance, or None for a source that dmrl did not write.
    """

    name: str
    sha256: str
    provenance: "Provenance | None" = None


@dataclass(frozen=True, slots=True)
class Provenance:
    """How an output was made.

    Parameters
    ----------
    stage
        The command's name.
    settings
        Every setting, as plain values.
    seed
        The random seed, or None where nothing is random.
    inputs
        What the stage read.
    libraries
        Versions of the packages that can change the result.
    dmrl_version
        Version of dmrl that wrote it.
    """

    stage: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    inputs: tuple[Input, ...] = ()
    libraries: Mapping[str, str] = field(default_factory=dict)
    dmrl_version: str = __version__

    def to_json(self) -> dict[str, Any]:
        """Plain dictionaries, lists and values, inputs' provenance nested, each told once."""
        return asdict(self._told_once())

    def _told_once(self) -> "Provenance":
        """The same, but with no provenance for an input that was there before, by its hash.

        Nor for one that is older than the budget: its hash stays, its story does not.
        """
        told: set[str] = set()

        def first_time(made: Provenance, depth: int) -> Provenance:
            inputs = []
            for source in made.inputs:
                known = source.sha256 in told or depth >= limits.ANCESTORS
                own = None if known else source.provenance
                if own is not None:
                    told.add(source.sha256)
                    own = first_time(own, depth + 1)
                inputs.append(replace(source, provenance=own))
            return replace(made, inputs=tuple(inputs))

        return first_time(self, 1)

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """The provenance that ``to_json`` gave.

        Raises
        ------
        KeyError, TypeError, ValueError
            If the document is not one.
        """
        try:
            return cls._read(document, {})
        except RecursionError:
            raise ValueError("it is nested too deep") from None

    @classmethod
    def _read(cls, document: Mapping[str, Any], known: dict[str, Self]) -> Self:
        inputs = []
        for source in document["inputs"]:
            name, sha256, own = source["name"], source["sha256"], source["provenance"]
            if own:
                known[sha256] = cls._read(own, known)
            inputs.append(Input(str(name), str(sha256), known.get(sha256)))
        made = cls(**{**document, "inputs": tuple(inputs)})
        if not (isinstance(made.settings, dict) and isinstance(made.libraries, dict)):
            raise TypeError("settings and libraries are no tables")
        texts = (made.stage, made.dmrl_version)
        if not all(isinstance(text, str) for text in texts) or not isinstance(
            made.seed, int | None
        ):
            raise TypeError("stage and version are no texts, or the seed is no number")
        return made

    def to_metadata(self) -> dict[str, str]:
        """The same as MCAP metadata: strings, JSON where a value is not one."""
        return {
            k: v if isinstance(v, str) else json.dumps(v, sort_keys=True)
            for k, v in self.to_json().items()
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self:
        """The provenance that ``to_metadata`` gave."""
        plain = ("stage", "dmrl_version")
        return cls.from_json({k: v if k in plain else parse_json(v) for k, v in metadata.items()})

    def to_recipe(self) -> str:
        """The settings as a TOML recipe: what was run can be run again."""
        return tomli_w.dumps({"kind": self.stage, **_without_none(self.settings)})

    def ancestry(self) -> Iterator[tuple[int, Input]]:
        """Depth of every input, and of theirs, nearest first; each with its provenance once."""
        yield from _nested(self._told_once(), 0)

    def write(self, folder: Path) -> None:
        """Write ``provenance.json`` into a dataset or run folder."""
        text = json.dumps(self.to_json(), indent=1, sort_keys=True)
        (folder / FILE_NAME).write_text(text + "\n", encoding="utf-8")


def _nested(made: Provenance, depth: int) -> Iterator[tuple[int, Input]]:
    for source in made.inputs:
        yield depth, source
        if source.provenance is not None:
            yield from _nested(source.provenance, depth + 1)


def _without_none(value: Any) -> Any:
    """The same without what TOML has no word for."""
    if isinstance(value, Mapping):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    return [_without_none(v) for v in value] if isinstance(value, list | tuple) else value
