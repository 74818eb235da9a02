"""Schemas: generated files are current, fields documented, names compatible."""

import re
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from dmrl import messages
from dmrl.messages import find_descriptor, message_class, serialize_schema

SCHEMAS = Path(__file__).parents[1] / "schemas"
PROTOS = sorted(SCHEMAS.glob("dmrl/v1/*.proto"))

# Fields that other programs read. They must not be renamed or removed.
CONTRACT = {
    "PeerPosition": "x y z covariance status",
    "PeerLabels": "peers",
    "PeerLabel": "peer u_px v_px depth_m sigma_u_px sigma_v_px sigma_depth_m box_px "
    "visible_share status source",
    "Detections": "detections",
    "Detection": "u_px v_px depth_m confidence class_id",
    "GridMap": "rows cols channels data",
    "Attitude": "roll_rad pitch_rad yaw_rad",
    "Velocity": "vx_mps vy_mps vz_mps",
    "Height": "height_m",
    "UwbRange": "range_m",
}


def test_the_descriptor_set_is_fresh() -> None:
    build = pytest.importorskip("dmrl.schemas.build", reason="needs the dev group")
    assert build.build_descriptor_set() == (SCHEMAS / "dmrl.binpb").read_bytes(), (
        "run: make schemas"
    )


@pytest.mark.parametrize("name", CONTRACT)
def test_contract_fields_are_there(name: str) -> None:
    full = find_descriptor(f"dmrl.v1.{name}")
    assert set(CONTRACT[name].split()) <= {field.name for field in full.fields}


def test_status_values_equal_the_schema() -> None:
    enum = find_descriptor("PeerLabel").fields_by_name["status"].enum_type
    values = {value.name: value.number for value in enum.values}
    assert values == {
        "OK": messages.STATUS_OK,
        "UNCONVERGED": messages.STATUS_UNCONVERGED,
        "AMBIGUOUS": messages.STATUS_AMBIGUOUS,
    }


@pytest.mark.parametrize("path", PROTOS, ids=lambda p: p.stem)
def test_every_message_has_a_comment(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    opened = [k for k, line in enumerate(lines) if re.match(r"(message|enum) ", line)]
    assert opened
    assert [lines[k] for k in opened if not lines[k - 1].startswith("//")] == []


@pytest.mark.parametrize("path", PROTOS, ids=lambda p: p.stem)
def test_every_field_has_a_unit_suffix_or_comment(path: Path) -> None:
    """A comment applies to all fields below it up to an empty line."""
    unexplained, explained = [], False
    for line in path.read_text(encoding="utf-8").splitlines():
        text = line.strip()
        if not text or text.startswith(("message ", "enum ")):
            explained = False
        elif text.startswith("//"):
            explained = True
        elif found := re.match(r"(?:repeated )?[\w.]+ (\w+) = \d+;", text):
            unit = re.search(r"_(px|m|s|ns|rad|mps|radps)$", found[1])
            # A field that holds a message is explained by the comment of that message.
            nested = re.match(r"(repeated )?[A-Z]", text)
            if not (explained or unit or nested):
                unexplained.append(found[1])
    assert unexplained == []


@pytest.mark.parametrize("path", PROTOS, ids=lambda p: p.stem)
def test_a_file_is_named_after_its_last_message(path: Path) -> None:
    names = re.findall(r"^(?:message|enum) (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    assert re.sub(r"(?<!^)(?=[A-Z])", "_", names[-1]).lower() == path.stem


def test_short_names_are_looked_up_in_dmrl_then_in_foxglove() -> None:
    assert find_descriptor("PeerLabels").full_name == "dmrl.v1.PeerLabels"
    assert find_descriptor("CompressedImage").full_name == "foxglove.CompressedImage"
    assert message_class("Height")(height_m=0.5).height_m == 0.5


def test_an_unknown_message_is_a_key_error() -> None:
    with pytest.raises(KeyError, match="Altitude"):
        message_class("Altitude")


@pytest.mark.parametrize("name", ["PeerLabels", "FrameTransforms"])
def test_schema_bytes_hold_all_that_a_message_imports_and_no_more(name: str) -> None:
    data = serialize_schema(name)
    files = FileDescriptorSet.FromString(data).file
    listed = {file.name for file in files}
    assert {d for file in files for d in file.dependency} < listed
    pool = messages.build_pool(data)
    assert pool.FindMessageTypeByName(find_descriptor(name).full_name).name == name
    assert len(listed) < len(
        FileDescriptorSet.FromString((SCHEMAS / "dmrl.binpb").read_bytes()).file
    )
