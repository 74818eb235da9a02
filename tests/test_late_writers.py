"""A writer whose output appears before it takes the lock leaves and removes nothing."""

from collections.abc import Callable
from pathlib import Path

import pytest

from dmrl import atomic_output
from dmrl.atomic_output import atomic_file, atomic_folder, to_partial_path
from dmrl.errors import OutputError


@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("keep", [True, False])
def test_late_writer_leaves_no_partial_file(
    kind: str, keep: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: several concurrent `dmrl train` or `render` with one name left NAME.partial."""
    out, take = tmp_path / "out", getattr(atomic_output, f"take_{kind}")

    def take_late(partial: Path) -> int:
        out.touch()  # another writer finishes between the check of the name and the lock
        held: int = take(partial)
        return held

    monkeypatch.setattr(atomic_output, f"take_{kind}", take_late)
    write: Callable[..., object] = atomic_file if kind == "file" else atomic_folder
    with pytest.raises(OutputError, match="exists"), write(out, keep_on_error=keep):  # type: ignore[attr-defined]
        raise AssertionError
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_late_writer_keeps_resumable_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, take = tmp_path / "out", atomic_output.take_folder
    to_partial_path(out).mkdir()
    (to_partial_path(out) / "epochs").write_text("a night")
    monkeypatch.setattr(
        atomic_output, "take_folder", lambda partial: (out.touch(), take(partial))[1]
    )
    with (
        pytest.raises(OutputError, match="exists"),
        atomic_folder(out, keep_on_error=True, resume=True),
    ):
        raise AssertionError
    assert (to_partial_path(out) / "epochs").read_text() == "a night"
