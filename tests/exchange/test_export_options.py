"""Options of `dmrl convert --to` that do not apply, and datasets of several cameras."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from dmrl.errors import SettingError
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.stages import convert, dataset
from dmrl.topics import CAMERA_IMAGE, LABELS

pytestmark = pytest.mark.heavy

WIDTH, HEIGHT, COUNT, STEP_NS = 64, 48, 4, 50_000_000
CAMERA = "width_px = {}\nheight_px = {}\nfx_px = 40.0\nfy_px = 40.0\ncx_px = 32.0\ncy_px = 24.0\n"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Build a dataset of two robots whose cameras take images at the same times."""
    with RecordingWriter(tmp_path / "flight.mcap", Provenance("test")) as sink:
        for k, robot in ((k, robot) for k in range(COUNT) for robot in ("cf1", "cf2")):
            rgb = np.full((HEIGHT, WIDTH, 3), 10 * k + int(robot[2:]), np.uint8)
            image = message_class("CompressedImage")(data=encode_png(rgb), format="png")
            peer = {"peer": "drone", "u_px": 9 + k, "v_px": 9, "depth_m": 1, "source": "hand"}
            sink.write(k * STEP_NS, CAMERA_IMAGE(robot), image)
            sink.write(k * STEP_NS, LABELS(robot), message_class("PeerLabels")(peers=[peer]))
    dataset.run([tmp_path / "flight.mcap"], tmp_path / "set", dataset.Settings())
    return tmp_path / "set"


def test_an_episode_has_all_images_of_a_robot(source: Path) -> None:
    out = source.parent / "out"
    convert.run(source, out, convert.Settings(to="lerobot"))
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [episode["length"] for episode in episodes] == [COUNT, COUNT]
    assert json.loads((out / "meta/info.json").read_text())["total_episodes"] == 2
    for number, robot in enumerate((1, 2)):
        path = out / f"data/chunk-000/file-{number:03d}.parquet"
        for k, row in enumerate(pq.read_table(path).to_pylist()):
            assert (row["frame_index"], row["log_time"]) == (k, k * STEP_NS)
            assert (row["index"], row["labels.u_px"]) == (number * COUNT + k, 9 + k)
            rgb = np.full((HEIGHT, WIDTH, 3), 10 * k + robot, np.uint8)
            assert row["observation.images.camera"]["bytes"] == encode_png(rgb)


@pytest.mark.parametrize(
    ("flags", "fault"),
    [
        ({"robot_width_m": 0.1}, "--robot-width-m and --camera go together"),
        ({"camera": (WIDTH, HEIGHT)}, "--robot-width-m and --camera go together"),
        ({"camera": (128, 96), "robot_width_m": 0.1}, "64 x 48 px, those of --camera 128 x 96 px"),
        ({"names": "drone=robot,cf9=cf2"}, "--names has no effect: .* has no cf9. Leave it out"),
    ],
)
@pytest.mark.parametrize("to", ["yolo", "coco"])
def test_an_option_without_effect_is_an_error(
    to: Any, flags: dict[str, Any], fault: str, source: Path, tmp_path: Path
) -> None:
    if "camera" in flags:
        (tmp_path / "camera.toml").write_text(CAMERA.format(*flags["camera"]))
        flags = flags | {"camera": tmp_path / "camera.toml"}
    with pytest.raises(SettingError, match=fault):
        convert.run(source, tmp_path / "out", convert.Settings(to=to, **flags))
    assert not (tmp_path / "out").exists()
