"""The names of `dmrl.plugins` are documented, defined where it says, and cheap to import."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from dmrl import plugins

EXTEND = Path(__file__).parents[1] / "docs" / "extend.md"


def test_names_for_plugins_are_documented() -> None:
    rows = EXTEND.read_text(encoding="utf-8").split("| from `dmrl.plugins` |")[1].split("\n\n")[0]
    named = [name for row in rows.splitlines()[2:] for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(plugins.PLACES)


@pytest.mark.parametrize("name", plugins.PLACES)
def test_every_name_for_plugins_is_at_its_place(name: str) -> None:
    assert getattr(plugins, name).__module__ == plugins.PLACES[name]
    listed = Path(plugins.__file__).read_text(encoding="utf-8")
    assert f"from {plugins.PLACES[name]} import {name} as {name}\n" in listed


def test_plugins_are_light_and_have_no_other_names() -> None:
    code = (
        "import sys, dmrl.plugins\n"
        "print(sorted({'numpy', 'torch', 'pyarrow', 'cyclopts'} & set(sys.modules)))\n"
        "try: dmrl.plugins.Former\n"
        "except AttributeError as e: print(e)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded, output = done.stdout.splitlines()
    assert loaded == "[]"
    assert output.startswith("dmrl.plugins has no Former. It has: Closing, Columns, Command")
