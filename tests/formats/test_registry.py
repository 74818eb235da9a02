"""Detection of the format of a source, and the errors if there is none."""

import os
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from dmrl import entry_points
from dmrl.entry_points import Plugin
from dmrl.errors import PluginError, SourceError, UnsafeName
from dmrl.formats import registry
from dmrl.formats.base import Content, Format, Options
from dmrl.formats.registry import GUESS_ORDER, find_format, load_builtin_formats
from dmrl.samples.sample import Sample

from . import foreign

FORMAT = Format(
    "theirs",
    "a log of theirs",
    lambda source: source.suffix == ".theirs",
    lambda *_: Content(iter(())),
)
BROKEN = Format("broken", "a log", lambda source: 1 / 0 > 0, lambda *_: 1 / 0)  # type: ignore[arg-type,return-value]


def load_failing_content() -> Content:
    """Return content whose second sample raises an error."""

    def iter_samples() -> object:
        yield Sample(1, "/cf1/height", "Height", {"height_m": 1.0})
        raise KeyError("altitude")

    return Content(iter_samples(), 5)  # type: ignore[arg-type]


LATE = Format(
    "late", "a log", lambda source: source.suffix == ".late", lambda *_: load_failing_content()
)
NONE = 1


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function that installs plug-ins, by their names and variables of this module."""

    def install(**values: str) -> None:
        rows = {
            name: Plugin(
                name,
                "their-logs",
                "",
                EntryPoint(name, f"{__name__}:{value}", entry_points.FORMATS),
            )
            for name, value in values.items()
        }
        monkeypatch.setattr(registry.entry_points, "find_plugins", lambda group: rows)

    return install


def test_formats_are_listed_in_detection_order() -> None:
    names = list(load_builtin_formats())
    assert tuple(names[: len(GUESS_ORDER)]) == GUESS_ORDER
    assert names[-1] == "images"
    assert names[len(GUESS_ORDER) : -1] == sorted(names[len(GUESS_ORDER) : -1]) != []
    assert all(name == form.name for name, form in load_builtin_formats().items())


def test_the_sources_of_each_are_known(tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(foreign.pack_usd_log())
    assert find_format(tmp_path / "log").name == "cfusdlog"
    folder = tmp_path / "pictures"
    folder.mkdir()
    for name, data in foreign.encode_grey_image().items():
        (folder / name).write_bytes(data)
    assert find_format(folder).name == "images"
    # A format that the user names is not checked.
    assert find_format(folder, "csv") is load_builtin_formats()["csv"]


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.txt", b"", "is empty, 0 bytes"),
        ("a.txt", b"x", "matches no known format. Pass --from: locanet, csv, "),
        ("a.mcap", b"x", "is a recording already. Pass --to: csv, parquet, ros2"),
    ],
)
def test_unknown_source_is_reported(name: str, data: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SourceError) as e:
        find_format(tmp_path / name)
    assert said in str(e.value) and name in str(e.value)


def test_empty_folder_missing_path_and_pipe_are_reported(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="is an empty folder"):
        find_format(tmp_path)
    with pytest.raises(SourceError, match=r"no file or folder .*nothing. Pass one"):
        find_format(tmp_path / "nothing")
    (tmp_path / "below.mcap").mkdir()
    (tmp_path / "below.mcap" / "a").write_bytes(b"x")
    with pytest.raises(SourceError, match=r"below\.mcap matches no known format"):
        find_format(tmp_path / "below.mcap")
    (tmp_path / "below").mkdir()
    os.mkfifo(tmp_path / "below" / "pipe")
    for name in (None, "images"):
        with pytest.raises(UnsafeName, match=r"pipe is a pipe or a device, not a file. Remove it"):
            find_format(tmp_path, name)
    with pytest.raises(UnsafeName, match=r"pipe is a pipe or a device, not a file. Name a file"):
        find_format(tmp_path / "below" / "pipe")


def test_misspelled_format_suggests_the_nearest(tmp_path: Path, plug: Callable[..., None]) -> None:
    plug(theirs="FORMAT")
    (tmp_path / "a").write_bytes(b"x")
    for name, hint in (
        ("imags", "Did you mean images? "),
        ("their", "Did you mean theirs? "),
        ("zz", ""),
    ):
        with pytest.raises(SourceError) as e:
            find_format(tmp_path / "a", name)
        assert f"--from {name}: no such format. {hint}Formats: locanet, csv" in str(e.value)
        assert str(e.value).endswith("images, theirs")


def test_plugin_formats_are_tried_after_built_in_ones_and_by_name(
    tmp_path: Path, plug: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    plug(broken="BROKEN", theirs="FORMAT", none="NONE")
    (tmp_path / "a.theirs").write_bytes(b"x")
    found = find_format(tmp_path / "a.theirs")
    assert (found.name, found.what) == ("theirs", "a log of theirs")
    assert found.recognises(tmp_path / "a.theirs") and not found.recognises(tmp_path / "a.txt")
    err = capsys.readouterr().err
    assert "of the package their-logs, fails to check" in err and "Skipped for" in err
    (tmp_path / "log").write_bytes(foreign.pack_usd_log())
    assert find_format(tmp_path / "log").name == "cfusdlog"
    assert find_format(tmp_path / "log", "theirs").name == "theirs"
    assert capsys.readouterr().err == ""
    with pytest.raises(
        PluginError, match=r"none, of the package their-logs, is not a dmrl.plugins"
    ):
        find_format(tmp_path / "log", "none")


def test_plugin_error_names_its_package(tmp_path: Path, plug: Callable[..., None]) -> None:
    plug(broken="BROKEN", late="LATE")
    (tmp_path / "a.late").write_bytes(b"x")
    with pytest.raises(
        PluginError, match=r"broken, of the package their-logs, fails to read .*Zero"
    ):
        find_format(tmp_path / "a.late", "broken").content(tmp_path / "a.late", Options())
    content = find_format(tmp_path / "a.late", "late").content(tmp_path / "a.late", Options())
    assert content.total == 5
    assert next(content.samples).fields == {"height_m": 1.0}
    with pytest.raises(
        PluginError, match=r"late, of the package their-logs, fails to read .*KeyErr"
    ):
        next(content.samples)
