"""Rendering to recordings by Blender; skipped where Blender is not set up."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import OutputError, RecordingError, SettingError
from dmrl.geometry.camera_file import format_camera
from dmrl.geometry.frames import Array, Camera, project
from dmrl.images.codec import decode, encode_png
from dmrl.recording import check, read, read_summary
from dmrl.recording.licences import licences_in
from dmrl.render_recording import read_render_camera
from dmrl.rendering.backgrounds.panorama import Panorama
from dmrl.rendering.camera.distortion import image_from_pinhole
from dmrl.rendering.randomise import SceneSource, draw_scene
from dmrl.rendering.renderer import Renderer, RobotModel
from dmrl.rendering.robots import crazyflie
from dmrl.rendering.settings import Settings
from dmrl.rendering.shot import Robot
from dmrl.stages.render import run

SMALL = Settings(
    images=6,
    robots_max=3,
    empty_share=0.2,
    painted_share=0.5,
    seed=3,
    workers=1,
    samples=4,
    masks=True,
    depths=True,
)


@pytest.fixture(scope="module")
def recording(blender: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return six images with up to three robots."""
    out = tmp_path_factory.mktemp("render") / "six.mcap"
    run(out, SMALL)
    return out


@pytest.mark.heavy
def test_a_recording_holds_images_labels_and_truth(recording: Path) -> None:
    found = read_summary(recording).topics
    per_image = ("camera/image", "camera/masks", "camera/depth", "labels", "attitude")
    assert {found[f"/cf1/{name}"].count for name in per_image} == {6}
    assert found["/cf1/camera/calibration"].count == 1
    assert found["/tf"].count == 6
    assert check(recording) == []


@pytest.mark.heavy
def test_masks_depths_and_labels_agree(recording: Path) -> None:
    topics = ("/cf1/labels", "/cf1/camera/masks")
    samples = list(read(recording, *topics))
    labels = {s.time_ns: s.message.peers for s in samples if s.topic == topics[0]}
    seen = 0
    makes = set()
    for sample in samples:
        if sample.topic != topics[1]:
            continue
        mask = decode(sample.message.data)[..., 0]
        for label in labels[sample.time_ns]:
            makes.add(label.peer[:-1])
            rows, cols = np.nonzero(mask == int(label.peer[-1]))
            if label.visible_share < 1 or not len(rows):
                continue
            edges = [cols.min(), rows.min(), cols.max() + 1, rows.max() + 1]
            assert np.abs(np.array(edges) - label.box_px).max() <= 1.5
            seen += 1
    assert seen
    assert makes == {"cf", "painted"}


@pytest.mark.slow
def test_the_number_of_workers_changes_no_byte(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "two.mcap"
    run(out, Settings(**{**_get_fields(SMALL), "workers": 2}))
    assert out.read_bytes() == recording.read_bytes()


def _get_fields(settings: Settings) -> dict[str, object]:
    """Return the values of all settings by name."""
    return {name: getattr(settings, name) for name in Settings.__dataclass_fields__}


@pytest.mark.slow
def test_killed_run_resumes_to_the_same_bytes(blender: Path, tmp_path: Path) -> None:
    # Lossless images are large, so that chunks fill up and are written early.
    recipe = tmp_path / "r.toml"
    recipe.write_text('kind = "render"\nimages = 24\nsamples = 1\nimage_format = "png"\n')
    whole, killed = tmp_path / "whole.mcap", tmp_path / "killed.mcap"
    command = [sys.executable, "-m", "dmrl.cli", "render", str(recipe)]
    subprocess.run([*command, str(whole), "--workers", "1"], check=True, capture_output=True)
    partial = tmp_path / "killed.mcap.partial"
    with subprocess.Popen([*command, str(killed)], stdout=subprocess.DEVNULL) as process:
        while not (partial.exists() and partial.stat().st_size > 300_000):
            assert process.poll() is None, "it ended before it could be killed"
            time.sleep(0.01)
        time.sleep(0.1)  # labels are written after their images
        os.kill(process.pid, signal.SIGKILL)
    assert not killed.exists()
    again = subprocess.run([*command, str(killed)], capture_output=True, text=True, check=False)
    assert again.returncode == 1
    assert "--resume" in again.stderr
    resumed = subprocess.run(
        [*command, str(killed), "--resume", "--json"], check=True, capture_output=True, text=True
    )
    assert '"resumed images": 0' not in resumed.stdout
    assert killed.read_bytes() == whole.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["killed.mcap", "r.toml", "whole.mcap"]


@pytest.mark.heavy
def test_resume_requires_equal_settings(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "out.mcap.partial").write_bytes(recording.read_bytes())
    with pytest.raises(RecordingError, match="other settings"):
        run(tmp_path / "out.mcap", Settings(images=6), resume=True)
    with pytest.raises(RecordingError, match="to resume"):
        run(tmp_path / "none.mcap", SMALL, resume=True)


@pytest.mark.slow
def test_a_worker_killed_on_the_way_changes_no_pixel(blender: Path) -> None:
    settings = Settings(images=6, robots_max=2, empty_share=0.0, samples=2)
    camera = read_render_camera(settings)
    grey = Panorama(np.full((8, 16, 3), 0.3, np.float32))
    shots = []
    for kill in (False, True):
        with Renderer(blender, RobotModel(), workers=1) as renderer:
            lights = tuple(renderer.lights)
            world = SceneSource(settings, camera, renderer.radius_m, lights, lambda _: grey, None)
            scenes = [draw_scene(world, k) for k in range(6)]
            if kill:
                os.kill(renderer.pool.pids[0], signal.SIGKILL)
            found = list(renderer.render_shots((camera, s.robots, s.look) for s in scenes))
            assert renderer.pool.replaced == kill
        shots.append(np.stack([shot.rgb for shot in found]))
    assert np.array_equal(*shots)


@pytest.mark.slow
def test_boxes_are_where_the_mesh_is(blender: Path) -> None:
    settings = Settings(images=30, empty_share=0.0, depth_m=(0.3, 1.0), seed=1)
    camera = read_render_camera(settings)
    grey = Panorama(np.full((8, 16, 3), 0.3, np.float32))
    errors = []
    with Renderer(blender, RobotModel()) as renderer:
        lights = tuple(renderer.lights)
        world = SceneSource(settings, camera, renderer.radius_m, lights, lambda _: grey, None)
        scenes = [draw_scene(world, k) for k in range(30)]
        shots = renderer.render_shots((camera, s.robots, s.look) for s in scenes)
        for scene, shot in zip(scenes, shots, strict=True):
            errors.append(shot.box_px[0] - _project_mesh(scene.robots[0], camera))
    assert np.median(np.abs(errors)) < 0.5
    assert np.percentile(np.abs(errors), 90) < 1.5


def _project_mesh(robot: Robot, camera: Camera) -> Array:
    """Return left, top, right and bottom of the projected mesh, pixels, clipped to the image."""
    turns = (robot.paint["rotor_first_rad"], robot.paint["rotor_sweep_rad"])
    points = crazyflie.outline_points(1.0, *turns)
    xyz = points @ robot.pose.camera_from_body.T + robot.pose.xyz_camera
    uv = image_from_pinhole(project(xyz, camera.image_from_optical)[0], camera)
    box = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
    return np.clip(box, 0, (camera.width_px, camera.height_px) * 2)


OWN = Camera(160, 120, 100.0, 101.0, 81.0, 58.0, (-0.28, 0.09, 0.0, 0.0, 0.0))


@pytest.mark.heavy
def test_licence_of_backgrounds_is_recorded(blender: Path, tmp_path: Path) -> None:
    photos, out = tmp_path / "hall", tmp_path / "out.mcap"
    photos.mkdir()
    (photos / "LICENSE").write_text("# CC BY-SA 3.0\n\nthe photographers\n")
    for k in range(2):
        (photos / f"{k}.png").write_bytes(encode_png(np.full((240, 320, 3), 90 + k, np.uint8)))
    run(out, Settings(images=1, backgrounds=photos, samples=1, workers=1))
    assert dict(licences_in(read_summary(out))) == {"hall": "CC BY-SA 3.0"}


@pytest.mark.heavy
def test_renders_are_taken_with_a_camera_of_the_user_s(blender: Path, tmp_path: Path) -> None:
    path, out = tmp_path / "mine.toml", tmp_path / "out.mcap"
    path.write_text(format_camera(replace(OWN, mount_rad=(0.0, 0.1, 0.0), delay_s=0.03)))
    settings = Settings(images=3, camera=path, empty_share=0.0, samples=2, workers=1)
    run(out, settings)
    calibration = next(iter(read(out, "/cf1/camera/calibration"))).message
    assert list(calibration.D)[:2] == [-0.28, 0.09]
    assert read_render_camera(settings) == OWN
    pictures = [decode(sample.message.data) for sample in read(out, "/cf1/camera/image")]
    assert {picture.shape for picture in pictures} == {(120, 160, 3)}
    made = read_summary(out).provenance
    assert made is not None
    assert [source.name for source in made.inputs] == ["mine.toml"]


def test_a_lens_that_cannot_fill_its_image_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(format_camera(replace(OWN, distortion=(-0.9,))))
    with pytest.raises(SettingError, match="folds back before the corners"):
        read_render_camera(Settings(camera=path))


def test_outputs_are_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "out.mcap").write_text("mine")
    with pytest.raises(OutputError, match="never overwritten"):
        run(tmp_path / "out.mcap", SMALL)
