"""Write dmrl/api/settings.pyi: the settings of every stage, as types for editors."""

import typing
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from dmrl.pipeline.stage_signature import signature_of

STAGES = {
    "label": "Label",
    "predict": "Predict",
    "track": "Track",
    "align": "Align",
    "trim": "Trim",
    "convert": "Convert",
    "fly": "Fly",
    "render": "Render",
    "sketch": "Sketch",
    "dataset": "Dataset",
    "train": "Train",
    "quantize": "Quantize",
    "calibrate": "Calibrate",
    "evaluate": "Evaluate",
}
ALSO = {"render": {"preset": "str"}}
"""Keys that a stage expands into settings."""
HEAD = '''# Written by `make docs` from the stages' settings. Do not edit.
"""Settings of the stages in Python, by name and type."""

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, Literal, TypedDict
'''


def type_text(hint: Any) -> str:
    """Return the source of a type; paths may be texts, and tuples any sequence."""
    origin, inside = get_origin(hint), get_args(hint)
    if origin is Literal:
        return f"Literal[{', '.join(map(repr, inside)).replace(chr(39), chr(34))}]"
    if origin in (typing.Union, UnionType):
        return " | ".join(type_text(one) for one in inside)
    if hint is Path:
        return "str | PathLike[str]"
    if origin in (tuple, list, Sequence):
        kinds = dict.fromkeys(type_text(one) for one in inside if one is not Ellipsis)
        return f"Sequence[{' | '.join(kinds)}]"
    if origin in (dict, Mapping):
        return f"Mapping[{type_text(inside[0])}, {type_text(inside[1])}]"
    if hint is NoneType:
        return "None"
    if isinstance(hint, type) and is_dataclass(hint):
        return "Mapping[str, Any]"
    return str(hint.__name__) if hint in (str, int, float, bool) else "Any"


def settings_types() -> str:
    """Return the text of dmrl/api/settings.pyi."""
    parts = [HEAD]
    for stage, name in STAGES.items():
        settings = signature_of(stage, writes=False).settings
        hints = get_type_hints(settings)
        keys = {f.name: type_text(hints[f.name]) for f in fields(settings)} | ALSO.get(stage, {})
        lines = [f"    {key}: {text}" for key, text in keys.items()]
        parts.append("\n".join([f"class {name}Settings(TypedDict, total=False):", *lines]) + "\n")
    return "\n".join(parts)
