"""TensorBoard logs on a full disk."""

import errno
import os
import time
from pathlib import Path

import pytest
from tensorboard.summary.writer.record_writer import RecordWriter

from dmrl.learn.training import tensorboard_log


def test_a_full_disk_gives_one_error_and_no_traceback_of_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(_: RecordWriter, data: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with (
        pytest.raises(OSError, match="No space left"),
        tensorboard_log.open_log(tmp_path, 0) as add,
    ):
        monkeypatch.setattr(RecordWriter, "write", full)
        until = time.monotonic() + 60
        while time.monotonic() < until:
            add("loss", 1.0, 1)
    assert capsys.readouterr().err == ""
