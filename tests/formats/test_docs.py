from dataclasses import fields
from pathlib import Path

import pytest

from dmrl.formats.image_folder import SUFFIXES
from dmrl.formats.known import FORMATS
from dmrl.formats.label_table import COLUMNS
from dmrl.geometry import Camera
from dmrl.stages.convert import CAMERAS

TEXT = (Path(__file__).parents[2] / "docs" / "sources.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", FORMATS)
def test_every_kind_is_documented(kind: str) -> None:
    assert f"## `{kind}`" in TEXT


def test_every_column_key_and_suffix_is_documented() -> None:
    keys = [field.name for field in fields(Camera)]
    assert [name for name in (*COLUMNS, *keys) if f"`{name}`" not in TEXT] == []
    assert all(name in TEXT for name in CAMERAS)
    assert " ".join(SUFFIXES) in TEXT
