"""Robot models of the user: files that can be read, and previews."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from dmrl.errors import BlenderError, OutputError, SettingError
from dmrl.geometry.frames import AIDECK, Array
from dmrl.images.codec import decode, encode_png
from dmrl.recording import read_table
from dmrl.render_recording import read_render_settings
from dmrl.rendering.camera.sensor import Sensor
from dmrl.rendering.renderer import Renderer, RobotModel
from dmrl.rendering.robot_preview import render_sides
from dmrl.rendering.robots import crazyflie
from dmrl.rendering.settings import Settings
from dmrl.rendering.shot import Light, Look, Robot
from dmrl.rendering.sketch_renderer import Pose
from dmrl.stages.render import command, run

CUBE = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + (
    "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
)
# A box of 1 x 3 x 2 with y up, as is usual in .obj files.
TOWER = "".join(
    f"v {words[1]} {3 * int(words[2])} {2 * int(words[3])}\n" if words[0] == "v" else f"{line}\n"
    for line in CUBE.splitlines()
    for words in [line.split()]
)


@pytest.mark.heavy
@pytest.mark.parametrize(("up", "height_m"), [("auto", 0.3), ("y", 0.3), ("z", 0.2)])
def test_an_obj_stands_upright(
    blender: Path, tmp_path: Path, up: Literal["auto", "y", "z"], height_m: float
) -> None:
    path = tmp_path / "tower.obj"
    path.write_text(TOWER)
    with Renderer(blender, RobotModel(path, 0.1, up), workers=1) as renderer:
        sides = np.ptp(renderer.points, axis=0)
    assert sides[2] == pytest.approx(height_m, abs=1e-6)
    assert sorted(sides) == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)


def _write_textured(folder: Path, texture: str) -> Path:
    """Write a cube, one half of each face red and the other blue, and return its path."""
    halves = np.zeros((8, 8, 3), np.uint8)
    halves[:, :4, 0] = halves[:, 4:, 2] = 255
    (folder / "halves.png").write_bytes(encode_png(halves))
    (folder / "cube.mtl").write_text(f"newmtl halves\nKd 1 1 1\nmap_Kd {texture}\n")
    at = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl halves\n"
    faces = [line.split()[1:] for line in CUBE.splitlines() if line.startswith("f")]
    rows = [" ".join(f"{corner}/{k}" for k, corner in enumerate(face, 1)) for face in faces]
    points = "mtllib cube.mtl\n" + CUBE.split("f", 1)[0]
    path = folder / "cube.obj"
    path.write_text(points + at + "".join(f"f {row}\n" for row in rows))
    return path


@pytest.mark.heavy
def test_a_texture_keeps_its_place_and_a_missing_one_is_named(
    blender: Path, tmp_path: Path
) -> None:
    path = _write_textured(tmp_path, "halves.png")
    with Renderer(blender, RobotModel(path, 0.1), workers=1, samples=4) as renderer:
        sides = [side.rgb.astype(int) for side in render_sides(renderer, crazyflie.CRAZYFLIE)]
    for rgb in sides:
        red, _, blue = np.moveaxis(rgb, 2, 0)
        assert min((red > blue + 50).sum(), (blue > red + 50).sum()) > 1_000
    path = _write_textured(tmp_path, "gone.png")
    with pytest.raises(BlenderError, match=r"cube\.obj .*: its texture gone\.png is missing"):
        run(tmp_path / "out.mcap", Settings(images=1, model=path, scale=0.1, workers=1))


@pytest.mark.heavy
def test_a_face_of_a_model_has_no_speckle(blender: Path, tmp_path: Path) -> None:
    path = tmp_path / "cube.obj"
    path.write_text(CUBE)
    camera = replace(AIDECK, distortion=())
    backdrop = np.full((camera.height_px, camera.width_px, 3), 0.3, np.float32)
    with Renderer(blender, RobotModel(path, 0.3), workers=1) as renderer:
        light = Light(
            renderer.lights[0], (0, 0, 0), 1.0, np.array([-1.0, 0, 1]), 2.0, (1, 1, 1), 0.1
        )
        robot = Robot(Pose(np.array([0.8, 0.0, 0.0]), np.eye(3)))
        (shot,) = renderer.render_shots([(camera, (robot,), Look(backdrop, light, Sensor()))])
    rows, columns = (
        slice(int(at.min()) + 8, int(at.max()) - 8) for at in np.nonzero(shot.opacity[0])
    )
    face = shot.rgb[rows, columns].astype(float)
    assert face.shape[0] > 30 and (shot.opacity[0][rows, columns] == 255).all()
    assert np.abs(np.diff(face, axis=1)).mean() < 1.0


@pytest.mark.heavy
@pytest.mark.parametrize("up", ["y", "z"])
def test_the_box_of_a_preview_is_about_what_it_shows(
    blender: Path, tmp_path: Path, up: Literal["y", "z"]
) -> None:
    path = tmp_path / "tower.obj"
    path.write_text(TOWER)
    with Renderer(blender, RobotModel(path, 0.1, up), workers=1, samples=4) as renderer:
        sides = {side.name: side for side in render_sides(renderer, crazyflie.CRAZYFLIE)}
        size_m = np.ptp(renderer.box, axis=0)
    for side in sides.values():
        rows, cols = np.nonzero(np.abs(side.rgb.astype(int) - side.rgb[0, 0]).max(axis=2) > 3)
        seen = [cols.min(), rows.min(), cols.max() + 1, rows.max() + 1]
        ends = side.edges_px.reshape(-1, 2)
        # Where an edge points at the camera, the outermost pixels are hardly covered.
        assert seen == pytest.approx([*ends.min(axis=0), *ends.max(axis=0)], abs=2.5)
    start, end = np.moveaxis(sides["from the front"].axes_px, 1, 0)
    # Seen from the front, the left of the robot (y) is on the right, and z points up.
    assert end[1, 0] > start[1, 0] + 50
    assert end[2, 1] < start[2, 1] - 50
    start, end = np.moveaxis(sides["from its left"].axes_px, 1, 0)
    assert end[0, 0] < start[0, 0] - 50
    assert size_m == pytest.approx([0.1, 0.2, 0.3] if up == "y" else [0.1, 0.3, 0.2], abs=1e-6)


@pytest.mark.heavy
def test_preview_shows_the_robot_and_prints_its_size(
    blender: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "robot.png"
    command("synthetic_first_look", out, preview=True, as_json=True)
    shown = json.loads(capsys.readouterr().out)
    assert shown["picture"] == str(out)
    vertices = crazyflie.CRAZYFLIE.build_mesh().vertices
    assert [shown[f"{axis} m"] for axis in "xyz"] == pytest.approx(
        np.ptp(vertices, axis=0), abs=1e-4
    )
    assert shown["px wide at 1 m"] == pytest.approx(183.73 * np.ptp(vertices[:, 1]), abs=0.1)
    assert decode(out.read_bytes()).std() > 10
    assert [path.name for path in tmp_path.iterdir()] == ["robot.png"]


def test_a_preview_is_refused_under_another_name_and_on_a_cluster(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"With --preview OUT is a picture: NAME\.png"):
        command("synthetic_first_look", tmp_path / "out.mcap", preview=True)
    with pytest.raises(SettingError, match="Leave out --on and --resume"):
        command("synthetic_first_look", tmp_path / "out.png", preview=True, resume=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.heavy
def test_a_scale_for_a_model_that_is_not_given_asks_for_it(blender: Path, tmp_path: Path) -> None:
    settings = read_render_settings("synthetic_published", images=1, workers=1)
    with pytest.raises(SettingError, match=r"Pass the --model of this scale"):
        run(tmp_path / "out.mcap", settings)


@pytest.mark.slow
def test_a_model_of_the_user_s_is_rendered_about_its_middle(blender: Path, tmp_path: Path) -> None:
    path = tmp_path / "cube.obj"
    path.write_text(CUBE)
    out = tmp_path / "out.mcap"
    run(out, Settings(images=3, model=path, scale=0.1, empty_share=0.0, samples=2, workers=1))
    labels = read_table(out, "/cf1/labels")["peers"].to_pylist()
    assert all(len(peers) == 1 for peers in labels)
    cornered = tmp_path / "origin.mcap"
    origin = Settings(images=3, model=path, model_centre="origin", scale=0.1, samples=2)
    run(cornered, replace(origin, empty_share=0.0))
    # The origin of the cube is a corner, half its diagonal from the middle.
    assert _measure_offsets(out).max() < 15
    assert _measure_offsets(cornered).min() > 5
    with pytest.raises(SettingError, match=r"robots of 100 m.*Change --scale"):
        run(tmp_path / "big.mcap", Settings(images=3, model=path, scale=100.0, workers=1))
    assert not (tmp_path / "big.mcap").exists()


def _measure_offsets(recording: Path) -> Array:
    """Return the distances of labels from the middles of their boxes, pixels times metres."""
    off = []
    for peers in read_table(recording, "/cf1/labels")["peers"].to_pylist():
        for peer in peers:
            left, top, right, bottom = peer["box_px"]
            if left > 0 and top > 0 and right < 320 and bottom < 224:
                away = np.hypot(
                    (left + right) / 2 - peer["u_px"], (top + bottom) / 2 - peer["v_px"]
                )
                off.append(away * peer["depth_m"])
    assert off
    return np.array(off)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["glb", "stl", "blend", "obj"])
def test_a_file_that_is_no_model_is_refused(blender: Path, tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"no.{kind}"
    path.write_text("this is no model\n")
    with pytest.raises(BlenderError, match=r"no\.\w+ is no model that Blender reads"):
        run(tmp_path / "out.mcap", Settings(images=1, model=path, workers=1))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_models_of_other_kinds_are_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "m.txt").write_text("x")
    with pytest.raises(SettingError, match="not a model"):
        Renderer(Path("none"), RobotModel(tmp_path / "m.txt"))
    with pytest.raises(SettingError, match="Check --model"):
        Renderer(Path("none"), RobotModel(tmp_path / "none.glb"))
