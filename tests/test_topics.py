"""The table of topics: its rows, patterns and messages."""

import pytest

from dmrl import topics
from dmrl.messages import LogType, find_descriptor, message_class
from dmrl.samples.flight import LOG_COLUMNS
from dmrl.topics import TOPICS, find_topic, list_robots, parse_topic


@pytest.mark.parametrize("row", TOPICS, ids=lambda row: row.pattern)
def test_every_row_names_a_message_that_exists(row: topics.Topic) -> None:
    if row.message == "dmrl.log.*":  # a message type is made for each log
        name = message_class(LogType("state", (("a.b", "f"),))).DESCRIPTOR.full_name
        assert row.accepts_message(name) and not row.accepts_message("dmrl.v1.Height")
        return
    assert find_descriptor(row.message).full_name == row.message
    assert row.accepts_message(row.message)


@pytest.mark.parametrize("row", TOPICS, ids=lambda row: row.pattern)
def test_a_topic_made_from_a_pattern_is_found_in_its_own_row_only(row: topics.Topic) -> None:
    topic = row.pattern.format(robot="cf1", peer="cf2", event="state")
    assert [r.pattern for r in TOPICS if parse_topic(r.pattern, topic) is not None] == [row.pattern]
    assert find_topic(topic) is row


def test_topic_patterns_are_unique() -> None:
    assert len({row.pattern for row in TOPICS}) == len(TOPICS)


def test_every_pattern_of_the_module_is_in_the_table() -> None:
    patterns = {v for k, v in vars(topics).items() if k.isupper() and isinstance(v, str)}
    assert patterns <= {row.pattern for row in TOPICS}


@pytest.mark.parametrize("row", TOPICS, ids=lambda row: row.pattern)
def test_curves_and_csv_columns_are_fields_of_the_message(row: topics.Topic) -> None:
    if row.curve is None and not row.csv:
        return
    fields = find_descriptor(row.message).fields_by_name
    wanted = {*row.csv, *(row.curve.fields if row.curve else ())}
    assert (row.sensor or not row.csv) and wanted <= set(fields)
    assert all(
        fields[f].cpp_type in (fields[f].CPPTYPE_DOUBLE, fields[f].CPPTYPE_FLOAT) for f in row.csv
    )
    assert row.curve is None or ", " in row.curve.title


def test_log_columns_are_those_of_own_sensors() -> None:
    assert tuple(field for row in topics.OWN_SENSORS for field in row.csv)[:6] == LOG_COLUMNS


@pytest.mark.parametrize(
    ("made", "topic"),
    [
        (topics.CAMERA_IMAGE("cf1"), "/cf1/camera/image"),
        (topics.CALIBRATION("cf1"), "/cf1/camera/calibration"),
        (topics.ATTITUDE("cf1"), "/cf1/attitude"),
        (topics.LABELS("cf1"), "/cf1/labels"),
        (topics.DETECTIONS("cf1"), "/cf1/detections"),
        (topics.GRID("cf1"), "/cf1/detections/grid"),
        (topics.TRUTH("cf1", "cf2"), "/cf1/peer/cf2/truth"),
    ],
)
def test_topics_are_spelled_as_other_programs_know_them(made: str, topic: str) -> None:
    assert made == topic


def test_a_robot_s_name_may_hold_any_sign_but_a_slash() -> None:
    assert parse_topic(topics.LABELS, "/cf1.a-b (2)/labels") == {"robot": "cf1.a-b (2)"}
    assert parse_topic(topics.LABELS, "/swarm/cf1/labels") is None
    assert parse_topic(topics.LABELS, "/cf1/labels\n") is None


def test_foreign_topics_have_no_row() -> None:
    assert find_topic("/rosout") is None
    assert find_topic("/cf1/camera/image/raw") is None


def test_robots_are_found_by_their_images_and_sorted() -> None:
    listed = ["/cf2/camera/image", "/cf1/camera/image", "/cf3/attitude", "/cf1/labels"]
    assert list_robots(listed) == ["cf1", "cf2"]
    assert list_robots(listed, topics.ATTITUDE) == ["cf3"]
    assert list_robots([]) == []
