"""The table of docs/reliability.md: what it names is there."""

import re
import tomllib
from pathlib import Path

TESTS = Path(__file__).parent
PAGE = TESTS.parent / "docs" / "reliability.md"
ROW = re.compile(
    r"^\| [^|]+ \| `([a-z0-9_/]+\.py)::(test_[a-z0-9_]+)` \| ([^|]*?) ?\|$", re.MULTILINE
)


def test_every_test_and_every_change_that_the_table_names_is_there() -> None:
    _, _, table = PAGE.read_text(encoding="utf-8").partition("## Which test holds what")
    rows = ROW.findall(table)
    assert len(rows) == table.count("\n| ") - 1 > 30  # all but the head
    changes = tomllib.loads((TESTS / "mutants.toml").read_text(encoding="utf-8"))
    known = {name for of in changes.values() for name in of}
    for file, name, change in rows:
        text = (TESTS / file).read_text(encoding="utf-8")
        assert re.search(rf"^def {name}\(", text, re.MULTILINE), f"{file}::{name}"
        assert not change or change in known, change
