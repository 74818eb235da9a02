"""The YAML front matter of a card, in the form that the Hugging Face Hub reads."""

from pathlib import Path
from typing import Any

import pyarrow as pa
from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

from dmrl.datasets import layout
from dmrl.errors import SettingError
from dmrl.guards.bounded_parsing import parse_json

HUB_LICENSES = ("unknown", "other", "odc-by", "odbl", "pddl", "c-uda")
"""Names of data licences that the Hub accepts and SPDX does not define."""

SIZE_CATEGORIES = {1_000: "n<1K", 10_000: "1K<n<10K", 100_000: "10K<n<100K", 1_000_000: "100K<n<1M"}


def read_front_matter(readme: Path) -> dict[str, str]:
    """Read the plain values of a card's front matter, by key; empty without a card."""
    if not readme.is_file():
        return {}
    lines = readme.read_text(encoding="utf-8").split("\n---\n")[0].splitlines()
    pairs = (line.partition(": ") for line in lines)
    return {key: _parse_scalar(value.strip()) for key, _, value in pairs if value}


def _parse_scalar(text: str) -> str:
    # dmrl writes JSON strings; a person may have written a bare word.
    try:
        return str(parse_json(text))
    except ValueError:
        return text


def check_license(text: str) -> None:
    """Raise SettingError unless SPDX or the Hugging Face Hub knows a licence.

    Parameters
    ----------
    text
        An SPDX expression in any case, or one of `HUB_LICENSES`.

    Raises
    ------
    SettingError
        If it is neither.
    """
    if text.lower() in HUB_LICENSES:
        return
    try:
        canonicalize_license_expression(text)
    except InvalidLicenseExpression:
        raise SettingError(
            f"--license {text}: neither SPDX nor the Hugging Face Hub has this licence. Try: "
            "cc-by-4.0, cc0-1.0, mit, other"
        ) from None


def name_size_category(images: int) -> str:
    """Return the Hub's name of a number of images."""
    return next((name for limit, name in SIZE_CATEGORIES.items() if images < limit), "n>1M")


def to_yaml_feature(column: pa.Field) -> dict[str, Any]:
    """Return a column as a feature of ``datasets``."""
    if column.name == layout.IMAGE:
        return {"name": column.name, "dtype": "image"}
    inner = _to_yaml_type(column.type)
    return {"name": column.name, **(inner if isinstance(inner, dict) else {"dtype": inner})}


def _to_yaml_type(kind: pa.DataType) -> Any:
    if pa.types.is_struct(kind):
        return [to_yaml_feature(f) for f in kind]
    if pa.types.is_fixed_size_list(kind):
        return {"list": _to_yaml_type(kind.value_type), "length": kind.list_size}
    if pa.types.is_list(kind):
        return {"list": _to_yaml_type(kind.value_type)}
    return layout.to_dtype_name(kind)
