"""Images of README.md and docs/ were drawn by the current code."""

import re
import runpy
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
MODULE: dict[str, Any] = runpy.run_path(str(ROOT / "docs/pictures.py"))
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]


@pytest.mark.parametrize("name", MODULE["PICTURES"])
@pytest.mark.heavy
def test_a_picture_was_drawn_by_the_present_recipe_and_code(name: str) -> None:
    assert MODULE["read_hash"](ROOT / name) == MODULE["compute_hash"](name), (
        f"make pictures, or .venv/bin/python docs/pictures.py {name}; then look at it"
    )


def test_every_picture_of_a_page_has_a_recipe_and_every_recipe_a_page() -> None:
    shown = {
        str((page.parent / target).resolve().relative_to(ROOT))
        for page in PAGES
        for target in re.findall(r"!\[[^\]]*\]\(([^)]+\.png)\)", page.read_text(encoding="utf-8"))
    }
    assert shown == set(MODULE["PICTURES"])
    stored = {str(path.relative_to(ROOT)) for path in ROOT.glob("docs/**/*.png")}
    assert stored == shown


def test_picture_hash_ignores_comments(
    tmp_path: Path,
) -> None:
    code = tmp_path / "code.py"
    read = MODULE["_read_code"]
    code.write_text('def f():\n    """Say."""\n    return 1  # why\n', encoding="utf-8")
    first = read(code)
    code.write_text('def f():\n    """Say more."""\n    return 1\n', encoding="utf-8")
    assert read(code) == first
    code.write_text("def f():\n    return 2\n", encoding="utf-8")
    assert read(code) != first


def test_the_strip_of_the_readme_is_as_wide_as_a_page() -> None:
    with Image.open(ROOT / "docs/images/front.png") as strip:
        assert strip.width == 1280
