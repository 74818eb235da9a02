"""Where a recording, dataset or model comes from: stage, settings, seed, inputs, libraries.

Each input carries its own provenance, so one output tells its whole ancestry.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import tomli_w

from dmrl import __version__

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
        """Plain dictionaries, lists and values, inputs' provenance nested."""
        return asdict(self)

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """The provenance that ``to_json`` gave.

        Raises
        ------
        KeyError, TypeError
            If the document is not one.
        """
        inputs = tuple(
            Input(
                i["name"], i["sha256"], cls.from_json(i["provenance"]) if i["provenance"] else None
            )
            for i in document["inputs"]
        )
        return cls(**{**document, "inputs": inputs})

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
        return cls.from_json({k: v if k in plain else json.loads(v) for k, v in metadata.items()})

    def to_recipe(self) -> str:
        """The settings as a TOML recipe: what was run can be run again."""
        settings = {k: v for k, v in self.settings.items() if v is not None}
        return tomli_w.dumps({"kind": self.stage, **settings})

    def ancestry(self) -> Iterator[tuple[int, str, "Provenance | None"]]:
        """Depth, name and provenance of every input, and of theirs, nearest first."""
        for source in self.inputs:
            yield 0, f"{source.name} sha256:{source.sha256[:12]}", source.provenance
            if source.provenance is not None:
                yield from ((depth + 1, n, p) for depth, n, p in source.provenance.ancestry())

    def write(self, folder: Path) -> None:
        """Write ``provenance.json`` into a dataset or run folder."""
        text = json.dumps(self.to_json(), indent=1, sort_keys=True)
        (folder / FILE_NAME).write_text(text + "\n", encoding="utf-8")
