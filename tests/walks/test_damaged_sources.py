"""Sources of every kind, each damaged in five ways.

Either a one-line error names the file and no recording is written, or the recording holds the
undamaged part and a line reports what was lost.
"""

from pathlib import Path

import pytest

from dmrl.errors import DmrlError
from dmrl.formats.registry import find_format
from dmrl.guards.safe_names import ERROR_CHARACTERS_MAX
from dmrl.stages import convert

from . import sources

pytestmark = pytest.mark.slow


def convert_source(source: Path, out: Path, kind: str | None = None) -> dict[str, int]:
    """Convert a source; return the number of messages by topic."""
    return convert.run(source, out, convert.Settings(kind, robot="cf1"))


@pytest.mark.parametrize("damage", sources.DAMAGES, ids=lambda damage: damage.__name__)
@pytest.mark.parametrize("kind", sources.KINDS)
@pytest.mark.parametrize("said_kind", [False, True], ids=["guessed", "said"])
def test_damage_is_refused_or_reported(
    said_kind: bool,
    kind: str,
    damage: sources.Callable[[bytes], bytes],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source, path = sources.KINDS[kind](tmp_path)
    name = find_format(source).name if said_kind else None
    whole = convert_source(source, tmp_path / "whole.mcap")
    capsys.readouterr()
    before = path.read_bytes()
    path.write_bytes(damage(before))
    out = tmp_path / "out.mcap"
    try:
        counts = convert_source(source, out, name)
    except DmrlError as e:
        assert not out.exists() and not [*tmp_path.glob("*.partial")]
        assert "\n" not in str(e) and len(str(e)) <= ERROR_CHARACTERS_MAX
        assert path.name in str(e) or source.name in str(e)
        return
    output = capsys.readouterr().err
    lost = {topic: count for topic, count in whole.items() if counts.get(topic, 0) < count}
    assert not lost or output, f"lost without a report: {lost}"


@pytest.mark.parametrize("damage", sources.DAMAGES, ids=lambda damage: damage.__name__)
@pytest.mark.parametrize("name", ["posLabel.txt", "train.txt", "boxLabel.txt"])
def test_damage_of_the_published_set_is_refused_or_reported(
    name: str,
    damage: sources.Callable[[bytes], bytes],
    data: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source, _ = sources.make_published_writer(data)(tmp_path)
    path = source / name
    if not path.is_file():
        path = next(p for p in sorted(source.rglob("*.txt")))
    path.write_bytes(damage(path.read_bytes()))
    try:
        convert_source(source, tmp_path / "out.mcap")
    except DmrlError as e:
        assert "\n" not in str(e) and (path.name in str(e) or source.name in str(e))
        return
    assert damage is not sources.truncate or capsys.readouterr().err
