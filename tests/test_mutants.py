"""Mutation testing: which changes are made, and which tests are run."""

from pathlib import Path

import pytest

from . import mutations
from .mutations import (
    Mutant,
    draw_mutants,
    find_tests,
    list_mutants,
    list_test_files,
    load_named_mutants,
)

SOURCE = '''"""Words of 1 + 1."""
from pathlib import Path

SIZE: tuple[int, 2] = (wide, high)

def far(a: int, b: float = 0.5) -> bool:
    """More 2 + 2."""
    if a < 3 and b:
        raise ValueError(f"{a + 1} is", a - 1)
    a += 4
    zip(a, b, strict=True)
    return -a * b[1:2] if max(a, b) else np.minimum(a, b)
'''


@pytest.fixture
def mutants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Mutant]:
    """Return every change of `SOURCE`, a module of a repository of one file."""
    monkeypatch.setattr(mutations, "REPOSITORY", tmp_path)
    (tmp_path / "dmrl" / "room").mkdir(parents=True)
    path = tmp_path / "dmrl" / "room" / "a.py"
    path.write_text(SOURCE)
    return list_mutants(path)


def test_every_mutation_is_applied_once_per_place(mutants: list[Mutant]) -> None:
    assert sorted((m.line, m.kind, m.before, m.after) for m in mutants) == [
        (4, "swap", "(wide, high)", "(high, wide)"),
        (6, "constant", "0.5", "1.0"),
        (8, "comparison", "a < 3", "(a <= 3)"),
        (8, "comparison", "a < 3", "(a > 3)"),
        (8, "constant", "3", "4"),
        (8, "term", "a < 3 and b", "(a < 3)"),
        (8, "term", "a < 3 and b", "(b)"),
        (10, "constant", "4", "5"),
        (10, "term", "a += 4", "pass"),
        (11, "swap", "zip(a, b, strict=True)", "(zip(b, a, strict=True))"),
        (12, "arithmetic", "-a * b[1:2]", "(-a / b[1:2])"),
        (12, "constant", "1", "2"),
        (12, "constant", "2", "3"),
        (12, "sign", "-a", "(a)"),
        (12, "sign", "-a * b[1:2]", "(-(-a * b[1:2]))"),
    ]


def test_tests_of_a_mutant_are_its_module_s_then_those_naming_it() -> None:
    def find(path: str) -> list[str]:
        return find_tests(Mutant(path, 1, "term", 0, 0, "", ""))

    found = find("dmrl/recording/recover.py")
    assert found[0] == "tests/recording/test_recover.py"
    assert "tests/recording/test_flips.py" in found
    assert "tests/recording/test_provenance_inputs.py" not in found
    assert len(find("dmrl/recording/nobody_names_this.py")) == len(list_test_files("recording"))


def test_every_change_can_be_compiled(mutants: list[Mutant]) -> None:
    source = SOURCE.encode()
    for mutant in mutants:
        assert source[mutant.start : mutant.end].decode() == mutant.before
        compile(source[: mutant.start] + mutant.after.encode() + source[mutant.end :], "a", "exec")


def test_mutants_are_drawn_evenly_and_reproducibly(mutants: list[Mutant]) -> None:
    first, again, other = (draw_mutants("room", 6, seed, ()) for seed in (1, 1, 2))
    assert first == again != other
    assert {m.kind for m in first} == {m.kind for m in mutants}
    assert len(draw_mutants("room", 99, 1, ())) == len(mutants)
    assert draw_mutants("room", 99, 1, ("a",)) == []


LIST = """
["dmrl/room/a.py"]
"off by one" = ["a < 3", "a < 4"]
"not there" = ["a < 9", "a < 8"]
"twice" = ["1", "2"]
["dmrl/other/b.py"]
tests = ["tests/other/test_c.py", "tests/test_d.py"]
"no file" = ["a", "b"]
"""


def test_named_mutants_are_found_and_missing_ones_reported(
    mutants: list[Mutant], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert mutants
    (tmp_path / "list.toml").write_text(LIST)
    monkeypatch.setattr(mutations, "NAMED", tmp_path / "list.toml")
    ((change, tests),), gone = load_named_mutants()
    assert (change.line, change.kind, change.after) == (8, "off by one", "a < 4")
    assert SOURCE.encode()[change.start : change.end] == b"a < 3"
    assert tests == ("tests/room/test_a.py",)
    assert [line.split(":")[1].strip() for line in gone] == ["not there", "twice", "no file"]
    assert load_named_mutants(("nobody",)) == ([], [])


def test_the_list_of_changes_can_be_read() -> None:
    changes, gone = load_named_mutants()
    assert len(changes) > 5 * len(gone)
    for change, tests in changes:
        assert change.before != change.after
        assert all((mutations.REPOSITORY / test).exists() for test in tests)


def test_every_named_mutant_applies() -> None:
    """A named change whose text was rewritten no longer proves that a test protects the code."""
    found, gone = load_named_mutants()
    assert not gone
    assert found
