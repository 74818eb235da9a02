"""Names from untrusted files: they leave no folder, end no comment, and become no markup."""

from pathlib import Path

import pytest

from dmrl import topics
from dmrl.errors import RecordingError, UnsafeName, to_one_line
from dmrl.guards.safe_names import (
    NAME_BYTES_MAX,
    check_split_name,
    comment_safe,
    escape_markdown,
    markdown_code,
    safe_join,
    to_topic_file_name,
)

HOSTILE = (
    *("", ".", "..", "../x", "../../victim", "/etc/passwd", "a/b", "a\\b", ".hidden", "a/../b"),
    *("a\nb", "a\0b", "a\x1b[31mb", "a\u202eb", "a" * (NAME_BYTES_MAX + 1), "ü" * NAME_BYTES_MAX),
)


@pytest.mark.parametrize("name", HOSTILE)
def test_no_name_leads_out_of_its_folder(name: str, tmp_path: Path) -> None:
    with pytest.raises(UnsafeName) as error:
        safe_join(tmp_path, name, "flight.mcap: the split")
    assert str(error.value).startswith("flight.mcap: the split")
    assert to_one_line(str(error.value)) == str(error.value)


@pytest.mark.parametrize("name", ["cf1", "Flug 3 (äöü)", "a.b", "x-1_2"])
def test_safe_names_are_unchanged(name: str, tmp_path: Path) -> None:
    assert safe_join(tmp_path, name, "it", suffix=".csv") == tmp_path / f"{name}.csv"


@pytest.mark.parametrize("name", [*HOSTILE, "data", "figures", "README.md", 'x"]; import os', "`"])
def test_split_name_must_be_a_word(name: str) -> None:
    with pytest.raises(UnsafeName):
        check_split_name(name, "it")


@pytest.mark.parametrize("name", ["Data", "readme.MD", "con", "AUX", "nul.x", "Com1", "lpt9"])
def test_splits_have_distinct_folders_on_every_file_system(name: str) -> None:
    with pytest.raises(UnsafeName, match="Rename it"):
        check_split_name(name, "it")
    assert check_split_name(f"x-{name}", "it") == f"x-{name}"


def test_topics_have_distinct_file_names() -> None:
    known = [
        *("/cf1/height", "/cf1.height", "cf1/height", "cf1.height", "/cf1%2Eheight", "/=cf1"),
        *("/cf1/height/", "//cf1/height", "/cf1/../height", "/../../victim", "/", "/cf1 height"),
        *("/=cf1/height", "=cf1/height", "/%3Dcf1/height", "/cf1\\height", "/cf1\nheight"),
    ]
    files = [to_topic_file_name(topic) for topic in known]
    assert len(set(files)) == len(known)
    assert not any(set("/\\\n") & set(name) for name in files)
    assert files[0] == "cf1.height"


@pytest.mark.parametrize("name", ["", "a/b", "a\nb", "a" * 300])
def test_robot_name_is_a_single_part_of_a_topic(name: str) -> None:
    with pytest.raises(UnsafeName, match="a robot is called"):
        topics.HEIGHT(name)


@pytest.mark.parametrize(
    "text", ["*/ int x; /*", "a\nb", "a\\\nb", "??/\n", '"', "$(shell x)", "\r", "\u2028", "`x`"]
)
def test_no_text_ends_a_comment(text: str) -> None:
    assert not set(comment_safe(text)) & set("*/\\\n\r?\"'$`\u2028<>[]#")


def test_markup_in_names_is_escaped() -> None:
    assert (
        escape_markdown("a|b<img src=x>[x](http://y)\nc") == r"a\|b\<img src=x\>\[x\](http:\//y) c"
    )
    assert escape_markdown("https://x WWW.y") == r"https:\//x WWW\.y"
    assert markdown_code("a`b") == "``a`b``"
    assert markdown_code("`") == "`` ` ``"
    assert markdown_code("a\n\n# b") == "`a  # b`"
    assert to_one_line("a\x1b]0;x\x07\u202eb\r\nc") == r"a\x1b]0;x\x07\u202eb c"


def test_errors_are_one_line_whatever_they_quote() -> None:
    """Error texts of libraries may contain line ends, for example about a damaged schema."""
    error = RecordingError("a.mcap is damaged (invalid name (\nheight\x1b[2J)). Try: dmrl recover")
    assert str(error) == r"a.mcap is damaged (invalid name ( height\x1b[2J)). Try: dmrl recover"
