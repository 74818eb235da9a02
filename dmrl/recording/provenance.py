"""Record the origin of a recording, dataset or model: stage, settings, seed, inputs, libraries.

Each input contains its own provenance, so an output contains its whole ancestry. A shared ancestor,
such as the model that labelled a hundred flights, is written in full only the first time.
Otherwise three rounds of labels over fifty flights took 300 MB of text.
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
"""File in a dataset or run folder."""
METADATA_NAME = "dmrl.provenance"
"""Metadata record in a recording."""


@dataclass(frozen=True, slots=True)
class Input:
    """An input of a stage.

    Parameters
    ----------
    name
        File or folder name without its path, so that outputs do not depend on the location.
    sha256
        Hash of the file, or of a folder's sorted names and contents.
    provenance
        Provenance of the input, or None for a source that dmrl did not write.
    """

    name: str
    sha256: str
    provenance: "Provenance | None" = None


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of an output.

    Parameters
    ----------
    stage
        Name of the command.
    settings
        All settings, as plain values.
    seed
        Random seed, or None if nothing is random.
    inputs
        Files and folders that the stage read.
    libraries
        Versions of the packages that can change the result.
    dmrl_version
        Version of dmrl that wrote it.
    left_out
        Number of things in the inputs that could not be used, by reason.
    """

    stage: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    inputs: tuple[Input, ...] = ()
    libraries: Mapping[str, str] = field(default_factory=dict)
    dmrl_version: str = __version__
    left_out: Mapping[str, int] = field(default_factory=dict)

    def list_settings(self) -> list[tuple[str, str]]:
        """Return names and texts of the settings that are set; those of a table as "table.name"."""
        return list(_iter_settings(self.settings))

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries, lists and values, with each input's provenance nested once."""
        return asdict(self._remove_repeats(), dict_factory=_drop_empty_count)

    def _remove_repeats(self) -> "Provenance":
        """Return a copy with the provenance of each input only at its first occurrence, by hash.

        Ancestors deeper than `limits.ANCESTORS` keep their hash without a provenance.
        """
        hashes: set[str] = set()

        def keep_first(made: Provenance, depth: int) -> Provenance:
            inputs = []
            for source in made.inputs:
                known = source.sha256 in hashes or depth >= limits.ANCESTORS
                own = None if known else source.provenance
                if own is not None:
                    hashes.add(source.sha256)
                    own = keep_first(own, depth + 1)
                inputs.append(replace(source, provenance=own))
            return replace(made, inputs=tuple(inputs))

        return keep_first(self, 1)

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Build the provenance from the result of ``to_json``.

        Raises
        ------
        KeyError, TypeError, ValueError
            If the document is not a provenance.
        """
        try:
            return cls._parse(document, {})
        except RecursionError:
            raise ValueError("it is nested too deep") from None

    @classmethod
    def _parse(cls, document: Mapping[str, Any], known: dict[str, Self]) -> Self:
        inputs = []
        for source in document["inputs"]:
            name, sha256, own = source["name"], source["sha256"], source["provenance"]
            if own:
                known[sha256] = cls._parse(own, known)
            inputs.append(Input(str(name), str(sha256), known.get(sha256)))
        made = cls(**{**document, "inputs": tuple(inputs)})
        tables = (made.settings, made.libraries, made.left_out)
        if not all(isinstance(table, dict) for table in tables):
            raise TypeError("settings, libraries and left_out are not tables")
        texts = (made.stage, made.dmrl_version)
        if not all(isinstance(text, str) for text in texts) or not isinstance(
            made.seed, int | None
        ):
            raise TypeError("stage and version are not texts, or the seed is not a number")
        return made

    def to_metadata(self) -> dict[str, str]:
        """Return MCAP metadata: strings, or JSON for other values."""
        values = self.to_json().items()
        return {k: v if isinstance(v, str) else json.dumps(v, sort_keys=True) for k, v in values}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self:
        """Build the provenance from the result of ``to_metadata``."""
        plain = ("stage", "dmrl_version")
        return cls.from_json({k: v if k in plain else parse_json(v) for k, v in metadata.items()})

    def to_recipe(self) -> str:
        """Return the settings as a TOML recipe that repeats the run."""
        return tomli_w.dumps({"kind": self.stage, **_drop_none(self.settings)})

    def iter_ancestors(self) -> Iterator[tuple[int, Input]]:
        """Yield depth and input for all direct and indirect inputs, each provenance once."""
        yield from _iter_nested(self._remove_repeats(), 0)

    def write(self, folder: Path) -> None:
        """Write ``provenance.json`` into a dataset or run folder."""
        text = json.dumps(self.to_json(), indent=1, sort_keys=True)
        (folder / FILE_NAME).write_text(text + "\n", encoding="utf-8")


def _iter_settings(settings: Mapping[str, Any], table: str = "") -> Iterator[tuple[str, str]]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _iter_settings(value, f"{table}{name}.")
        elif value is not None and value is not False and value not in ("", [], ()):
            yield f"{table}{name}", str(value)


def _drop_empty_count(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build a dictionary without an empty ``left_out``, which earlier versions do not write."""
    return {key: value for key, value in pairs if key != "left_out" or value}


def _iter_nested(made: Provenance, depth: int) -> Iterator[tuple[int, Input]]:
    for source in made.inputs:
        yield depth, source
        if source.provenance is not None:
            yield from _iter_nested(source.provenance, depth + 1)


def _drop_none(value: Any) -> Any:
    """Return the value without None, which TOML cannot express."""
    if isinstance(value, Mapping):
        return {k: _drop_none(v) for k, v in value.items() if v is not None}
    return [_drop_none(v) for v in value] if isinstance(value, list | tuple) else value
