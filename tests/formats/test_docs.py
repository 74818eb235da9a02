"""docs/sources.md describes every format, and its example works."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.files.image_folder import IMAGE_SUFFIXES
from dmrl.formats.files.label_csv import COLUMNS
from dmrl.formats.registry import load_builtin_formats
from dmrl.geometry.camera_file import NAMED_CAMERAS
from dmrl.geometry.frames import Camera

TEXT = (Path(__file__).parents[2] / "docs" / "sources.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", load_builtin_formats())
def test_every_kind_is_documented(kind: str) -> None:
    assert f"## `{kind}`" in TEXT


def test_every_column_key_and_suffix_is_documented() -> None:
    keys = [field.name for field in fields(Camera)]
    assert [name for name in (*COLUMNS, *keys) if f"`{name}`" not in TEXT] == []
    assert all(name in TEXT for name in NAMED_CAMERAS)
    assert " ".join(IMAGE_SUFFIXES) in TEXT


def test_documented_format_example_works(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "add-a-format.md").read_text(encoding="utf-8")
    code = page.split("```python\n")[1].split("```")[0]
    example: dict[str, Any] = {}
    exec(compile(code, "add-a-format.md", "exec"), example)
    rows = np.array([(0.5, 1.5, 0.0), (1.0, 1.6, 2.5)], example["RECORD"])
    path = tmp_path / "flight.ulg2"
    path.write_bytes(b"UL2" + rows.tobytes() + b"cut")
    form = example["FORMAT"]
    assert form.recognises(path)
    found = [
        (s.time_ns, s.topic, *s.fields.values()) for s in form.content(path, Options()).samples
    ]
    assert found == [
        (500_000_000, "/cf1/height", 1.5),
        (1_000_000_000, "/cf1/height", pytest.approx(1.6)),
        (1_000_000_000, "/cf1/range/cf3", 2.5),
    ]
    assert form.uses == {"robot", "names"}
    path.write_bytes(b"UL2" + np.array([(np.nan, 1.5, 0)], example["RECORD"]).tobytes())
    with pytest.raises(SourceError, match=r"flight\.ulg2: time nan s in row 0"):
        form.content(path, Options())
    path.write_bytes(b"UL2")
    with pytest.raises(SourceError, match="has no whole record"):
        form.content(path, Options())
