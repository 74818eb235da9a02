"""Every command that copies keeps the content of MCAP's conformance suite of 416 recordings."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from mcap.stream_reader import StreamReader

from dmrl.stages import check, info, merge, recover, trim

from .walk import Content, walk

FILES, SAMPLED = 416, 13
OTHER = {"NoData.mcap": "NoData-st.mcap"}
"""The empty recording to merge each file with. Merging a file with itself is an error."""


def read_description(path: Path) -> Content:
    """Return the content of a file as the suite describes it."""
    found = Content()
    for record in json.loads(path.with_suffix(".json").read_text())["records"]:
        told = dict(record["fields"])
        if record["type"] == "Schema":
            data = bytes(map(int, told["data"]))
            found.schemas[int(told["id"])] = told["name"], told["encoding"], data
        elif record["type"] == "Channel":
            metadata = tuple(sorted(told["metadata"].items()))
            found.channels[int(told["id"])] = (
                told["topic"],
                told["message_encoding"],
                metadata,
                int(told["schema_id"]),
            )
        elif record["type"] == "Message":
            numbers = (told[k] for k in ("channel_id", "log_time", "publish_time", "sequence"))
            found.raw_messages.append((*map(int, numbers), bytes(map(int, told["data"]))))
        elif record["type"] == "Attachment":
            times = int(told["log_time"]), int(told["create_time"])
            data = bytes(map(int, told["data"]))
            found.attachments.append((told["name"], told["media_type"], *times, data))
        elif record["type"] == "Metadata":
            found.metadata.append((told["name"], tuple(sorted(told["metadata"].items()))))
    return found


def read_by_mcap(path: Path) -> Content:
    """Return the content of a file as the mcap package reads it."""
    by_kind: dict[str, list[Any]] = defaultdict(list)
    with path.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            by_kind[type(record).__name__].append(record)
    return Content(
        {s.id: (s.name, s.encoding, s.data) for s in by_kind["Schema"]},
        {
            c.id: (c.topic, c.message_encoding, tuple(sorted(c.metadata.items())), c.schema_id)
            for c in by_kind["Channel"]
        },
        [
            (m.channel_id, m.log_time, m.publish_time, m.sequence, m.data)
            for m in by_kind["Message"]
        ],
        [(a.name, a.media_type, a.log_time, a.create_time, a.data) for a in by_kind["Attachment"]],
        [(m.name, tuple(sorted(m.metadata.items()))) for m in by_kind["Metadata"]],
    )


def check_commands(path: Path, folder: Path) -> None:
    """Assert that info and check count, and every copy keeps, what the suite describes."""
    content = read_description(path)
    want = content.comparable()
    assert walk(path).comparable() == read_by_mcap(path).comparable() == want
    told, checked = info.run(path).to_document(), check.run(path)
    assert told["messages"] == checked.messages == len(want["messages"])
    assert list(told["topics"]) == sorted({topic for topic, *_ in want["channels"]})
    assert told["attachments"] == [name for name, *_ in want["attachments"]]
    assert list(told["metadata"]) == [name for name, _ in want["metadata"]]
    assert {f.text for f in checked.findings if f.level == "error"} <= {
        "the recording has no messages"
    }
    out = folder / "out.mcap"
    other = path.with_name(OTHER.get(path.name, "NoData.mcap"))
    for copy in (
        lambda: trim.run(path, out, trim.Settings()),
        lambda: merge.run([path, other], out),
        lambda: recover.run(path, out),
    ):
        copy()
        assert walk(out).comparable() == read_by_mcap(out).comparable() == want
        out.unlink()


@pytest.fixture
def suite(data: Path) -> list[Path]:
    """Return the recordings of the conformance suite."""
    folder = data / "mcap-conformance"
    if not folder.is_dir():
        pytest.skip("MCAP's conformance suite is not there")
    return sorted(folder.glob("*.mcap"))


@pytest.mark.heavy
def test_a_sample_of_the_conformance_suite_is_copied_whole(
    suite: list[Path], tmp_path: Path
) -> None:
    for path in suite[::SAMPLED]:
        check_commands(path, tmp_path)


@pytest.mark.heavy
def test_the_conformance_suite_is_copied_whole(suite: list[Path], tmp_path: Path) -> None:
    for path in suite:
        check_commands(path, tmp_path)
    assert len(suite) == FILES
