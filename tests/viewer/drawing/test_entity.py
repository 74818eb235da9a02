"""Names of entities: robot names are escaped in rerun's patterns."""

import re

import pytest

from dmrl.viewer.drawing.entity import escape_path


@pytest.mark.parametrize(
    "name", ["**", "$origin", "- /x", "+ /**", "a\n- /**", "{x}", "a\\", "..", "x\x1b[2J", "a b"]
)
def test_robot_name_is_escaped_in_view_contents(name: str) -> None:
    path = escape_path(f"/{name}/camera/image")
    assert path.startswith("/") and path.endswith("/camera/image")
    assert path.isprintable() and re.search(r"(?<!\\)[*$+ ]", path) is None
    assert escape_path(f"/{name}x/camera/image") != path
