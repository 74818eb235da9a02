"""The tables of docs/reliability.md and SECURITY.md name existing tests."""

import re
import tomllib
from pathlib import Path

TESTS = Path(__file__).parent
PAGE = TESTS.parent / "docs" / "reliability.md"
ROW = re.compile(
    r"^\| [^|]+ \| `([a-z0-9_/]+\.py)::(test_[a-z0-9_]+)` \| ([^|]*?) ?\|$", re.MULTILINE
)


def require_test(file: str, name: str) -> None:
    """Assert that a file of tests defines a test."""
    text = (TESTS / file).read_text(encoding="utf-8")
    assert re.search(rf"^def {name}\(", text, re.MULTILINE), f"{file}::{name}"


def test_every_claim_of_security_md_has_a_test() -> None:
    page = (TESTS.parent / "SECURITY.md").read_text(encoding="utf-8")
    table = page.partition("## Which test holds what")[2].partition("\n## ")[0]
    rows = re.findall(
        r"^\| [^|]+ \| `([a-z0-9_/]+\.py)::(test_[a-z0-9_]+)` \|$", table, re.MULTILINE
    )
    assert len(rows) == table.count("\n| ") - 1 > 30
    for file, name in rows:
        require_test(file, name)


def test_tests_and_mutants_of_reliability_md_exist() -> None:
    _, _, table = PAGE.read_text(encoding="utf-8").partition("## Which test holds what")
    rows = ROW.findall(table)
    assert len(rows) == table.count("\n| ") - 1 > 30  # every row but the header
    changes = tomllib.loads((TESTS / "mutants.toml").read_text(encoding="utf-8"))
    known = {name for of in changes.values() for name in of}
    for file, name, change in rows:
        require_test(file, name)
        assert not change or change in known, change
