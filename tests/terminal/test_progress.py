"""Progress bars and messages on standard error."""

import pytest

from dmrl.terminal.progress import say, track


def test_a_pipe_gets_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track(range(5), "Counting")) == [0, 1, 2, 3, 4]
    assert list(track(iter("ab"), "Counting", 2)) == ["a", "b"]
    assert capsys.readouterr() == ("", "")


def test_a_log_gets_periodic_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmrl.terminal.progress.LOG_PERIOD_S", 0.0)
    assert list(track(range(3), "Counting")) == [0, 1, 2]
    assert list(track(iter("ab"), "Counting", describe=lambda letter: f"at {letter}")) == ["a", "b"]
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "Counting: 1 of 3, about 0 min left",
        "Counting: 2 of 3, about 0 min left",
        "at b: 1",
    ]


def test_a_terminal_gets_a_bar(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    assert list(track(range(3), "Counting")) == [0, 1, 2]
    out, err = capsys.readouterr()
    assert out == ""
    assert "Counting" in err


def test_progress_description_may_follow_the_items(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    assert list(track(range(3), "Counting", describe=lambda k: f"number {k}")) == [0, 1, 2]
    assert "number 2" in capsys.readouterr().err


def test_messages_go_to_stderr_unchanged(capsys: pytest.CaptureFixture[str]) -> None:
    say("left out: [bold]3 " + "x" * 200)
    assert capsys.readouterr() == ("", "left out: [bold]3 " + "x" * 200 + "\n")
