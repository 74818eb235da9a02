# SPDX-License-Identifier: GPL-3.0-or-later
#
# Copyright (C) 2026 The dmrl developers
#
# This program is free software: you can redistribute it and/or modify it under the terms of
# the GNU General Public License as published by the Free Software Foundation, either version
# 3 of the License, or (at your option) any later version. It is distributed in the hope that
# it will be useful, but WITHOUT ANY WARRANTY; without even the implied warranty of
# MERCHANTABILITY or FITNESS FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
"""A robot's colour, opacity and depth as a pinhole camera sees it, over a pipe.

Run by path in Blender's own Python; the only file that imports bpy. Blender's world is
dmrl's camera frame: x forward, y left, z up, metres, the camera at the origin. Light turns
with gravity. Every answer depends on its request alone, not on those before it.
"""

import math
import os
import sys
from pathlib import Path

import bpy
import numpy as np
from cycles import CyclesRender
from mathutils import Matrix
from protocol import receive, send

# The camera of Blender looks along its -z, y up.
WORLD_FROM_CAMERA = Matrix(((0, 0, -1, 0), (-1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
SENSOR_MM = 32.0
# A crop's edges in the middle of pixels' quarters, so that rounding cannot move them.
NUDGE_PX = 0.25
PASSES = {"Combined": 4, "Depth": 1}
LIGHT_SIZE_PX = (32, 16)
MEAN_LIGHT = 0.5
LIGHT_CAP = 8.0

_taken = {}


def _render_and_take(self, depsgraph):
    """Cycles' own render, after which the passes are read where they lie in memory."""
    _original_render(self, depsgraph)
    result = self.get_result()
    for one in result.layers[0].passes:
        if one.name in PASSES:
            buffer = np.empty(result.resolution_x * result.resolution_y * one.channels, np.float32)
            one.rect.foreach_get(buffer)
            shape = (result.resolution_y, result.resolution_x, one.channels)
            _taken[one.name] = buffer.reshape(shape)[::-1]


_original_render = CyclesRender.render


class Stage:
    """The scene: one robot, one camera, a sun and a world of light."""

    def __init__(self, head, arrays):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self.settings(head)
        self.camera = self.add("camera", bpy.data.cameras.new("camera"))
        self.camera.matrix_world = WORLD_FROM_CAMERA
        self.camera.data.sensor_fit = "HORIZONTAL"
        self.camera.data.sensor_width = SENSOR_MM
        self.camera.data.clip_start, self.camera.data.clip_end = 0.005, 100.0
        self.scene.camera = self.camera
        self.sun = self.add("sun", bpy.data.lights.new("sun", "SUN"))
        self.world(head["lights"])
        if head["model"] is None:
            self.robot = self.drawn(head, arrays)
        else:
            self.robot = self.loaded(Path(head["model"]), head["model_scale"], head["model_up"])

    def settings(self, head):
        render, cycles = self.scene.render, self.scene.cycles
        render.engine = "CYCLES"
        cycles.device = "CPU"
        cycles.samples = head["samples"]
        cycles.use_denoising = cycles.use_adaptive_sampling = False
        # A filter as wide as the pixel: opacity is the share of the pixel that is covered.
        cycles.pixel_filter_type = "BOX"
        cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = head["bounces"]
        cycles.transparent_max_bounces = 8
        cycles.caustics_reflective = cycles.caustics_refractive = False
        cycles.sample_clamp_indirect = 4.0
        cycles.use_light_tree = False  # built anew for every image, at half its cost
        render.threads_mode, render.threads = "FIXED", 1
        render.use_persistent_data = True
        render.film_transparent = True
        render.use_border = render.use_crop_to_border = True
        render.use_compositing = render.use_sequencer = False
        render.resolution_percentage = 100
        self.scene.view_settings.view_transform = "Raw"
        self.scene.view_layers[0].use_pass_z = True

    def add(self, name, data):
        thing = bpy.data.objects.new(name, data)
        self.scene.collection.objects.link(thing)
        return thing

    def world(self, lights):
        """One world for all panoramas, one above the other in one picture.

        A world for each would be loaded anew at every change, which takes longer than a robot.
        """
        columns, rows = LIGHT_SIZE_PX
        atlas = bpy.data.images.new("light", columns, rows * len(lights), float_buffer=True)
        atlas.pixels.foreach_set(np.concatenate([_small(name) for name in lights]).ravel())
        self.numbers = {name: k for k, name in enumerate(lights)}
        self.scene.world = world = bpy.data.worlds.new("world")
        world.use_nodes = True
        world.cycles.sampling_method = "MANUAL"
        world.cycles.sample_map_resolution = 2 * columns
        tree = world.node_tree
        self.background = tree.nodes["Background"]
        place = tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"]
        self.turn = _node(tree, "Mapping", place)
        x, y, z = _node(tree, "SeparateXYZ", self.turn.outputs[0]).outputs
        turn = _math(tree, "DIVIDE", _math(tree, "ARCTAN2", y, x), -2 * math.pi)
        height = _math(tree, "DIVIDE", _math(tree, "ARCSINE", z), math.pi)
        # Half a row from the edges, where the next panorama would shine in.
        height = _math(tree, "MULTIPLY", _math(tree, "ADD", height, 0.5), (rows - 1) / rows)
        height = _math(tree, "ADD", height, 0.5 / rows)
        self.number = _node(tree, "Math", height, 0.0, operation="ADD")
        up = _math(tree, "DIVIDE", self.number.outputs[0], len(lights))
        where = _node(tree, "CombineXYZ", _math(tree, "ADD", turn, 0.5), up, 0.0)
        picture = _node(tree, "TexImage", where.outputs[0], image=atlas)
        tree.links.new(picture.outputs["Color"], self.background.inputs["Color"])

    def drawn(self, head, arrays):
        """The robot that dmrl draws: vertices in metres, triangles, a material each."""
        mesh = bpy.data.meshes.new("robot")
        mesh.from_pydata(arrays["vertices"].tolist(), [], arrays["faces"].tolist())
        mesh.polygons.foreach_set("material_index", arrays["material"].astype(np.int32))
        polar = mesh.attributes.new("rotor", "FLOAT_VECTOR", "POINT")
        polar.data.foreach_set("vector", arrays["rotor"].astype(np.float32).ravel())
        for k, name in enumerate(head["materials"]):
            material = bpy.data.materials.new(name)
            _paint(material, k)
            if name == "rotor":
                _show_blades(material, head)
            mesh.materials.append(material)
        mesh.update()
        return self.add("robot", mesh)

    def loaded(self, path, scale, up):
        """The user's model, as one mesh about the middle of its bounding box."""
        meshes = _meshes(path)
        robot = bpy.data.meshes.new("robot")
        corners, faces, indices, start = [], [], [], 0
        for mesh, matrix in meshes:
            mesh.calc_loop_triangles()
            points = np.array([matrix @ v.co for v in mesh.vertices]).reshape(-1, 3)
            base = len(robot.materials)
            for material in mesh.materials or [None]:
                robot.materials.append(material)
            corners.append(points)
            faces += [[start + v for v in t.vertices] for t in mesh.loop_triangles]
            indices += [base + t.material_index for t in mesh.loop_triangles]
            start += len(points)
        if not faces:
            raise ValueError("it has no surface")
        points = np.concatenate(corners) * scale
        if up == "y":
            points = np.column_stack([points[:, 0], -points[:, 2], points[:, 1]])
        points -= (points.min(axis=0) + points.max(axis=0)) / 2
        robot.from_pydata(points.tolist(), [], faces)
        robot.polygons.foreach_set("material_index", np.array(indices, np.int32))
        robot.update()
        return self.add("robot", robot)

    def points(self):
        found = np.empty(3 * len(self.robot.data.vertices), np.float32)
        self.robot.data.vertices.foreach_get("co", found)
        return found.reshape(-1, 3)

    def shoot(self, head):
        """(H, W, 4) premultiplied light and opacity and (H, W) depth of a crop."""
        self.aim(head)
        self.light(head)
        robot = self.robot
        robot.matrix_world = Matrix(head["camera_from_body"])
        for name, value in head["paint"].items():
            robot[name] = value
        robot.update_tag()
        self.scene.cycles.seed = head["seed"]
        _taken.clear()
        bpy.ops.render.render()
        if len(_taken) != len(PASSES):
            raise RuntimeError(f"Blender {bpy.app.version_string} does not hand over its passes")
        return {"light": _taken["Combined"], "depth": _taken["Depth"][..., 0]}

    def aim(self, head):
        width, height = head["size_px"]
        fx, fy, cx, cy = head["intrinsics_px"]
        render, lens = self.scene.render, self.camera.data
        render.resolution_x, render.resolution_y = width, height
        render.pixel_aspect_x, render.pixel_aspect_y = max(fy / fx, 1.0), max(fx / fy, 1.0)
        lens.lens = SENSOR_MM * fx / width
        # Shifts are in units of the image's width, of square pixels.
        lens.shift_x, lens.shift_y = (width / 2 - cx) / width, (cy - height / 2) * fx / fy / width
        left, top, right, bottom = head["crop_px"]
        render.border_min_x, render.border_max_x = (
            (left + NUDGE_PX) / width,
            (right + NUDGE_PX) / width,
        )
        low, high = height - bottom, height - top
        render.border_min_y, render.border_max_y = (
            (low + NUDGE_PX) / height,
            (high + NUDGE_PX) / height,
        )

    def light(self, head):
        self.number.inputs[1].default_value = self.numbers[head["light"]]
        self.turn.inputs["Rotation"].default_value = head["light_turn_rad"]
        self.background.inputs["Strength"].default_value = head["light_strength"]
        self.sun.data.energy = head["sun_strength"]
        self.sun.data.color = head["sun_colour"]
        self.sun.data.angle = head["sun_angle_rad"]
        self.sun.matrix_world = Matrix(head["sun_matrix"])


def _small(name):
    """(rows, columns, 4) a panorama's light by large parts, of mean MEAN_LIGHT.

    Small hard lights would make fireflies; the sun of the scene is there for them.
    """
    columns, rows = LIGHT_SIZE_PX
    wide = _panorama(name)[::-1]
    height, width, _ = wide.shape
    down, across = height // rows, width // columns
    if not (down and across):
        raise ValueError(f"{name} is smaller than {columns}x{rows} pixels")
    part = wide[: down * rows, : across * columns]
    small = part.reshape(rows, down, columns, across, 3).mean(axis=(1, 3))
    small *= MEAN_LIGHT / max(small.mean(), 1e-9)
    small = np.minimum(small, LIGHT_CAP * MEAN_LIGHT)
    return np.dstack([small, np.ones((rows, columns, 1))]).astype(np.float32)


def _panorama(name):
    """(H, W, 3) linear light of a picture, all around, top row first."""
    image = bpy.data.images.load(name)
    width, height = image.size
    pixels = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3]


def _node(tree, kind, *inputs, **options):
    """A new node with its inputs linked or set, in order."""
    node = tree.nodes.new(f"ShaderNode{kind}")
    for name, value in options.items():
        setattr(node, name, value)
    for socket, value in zip(node.inputs, inputs, strict=False):
        if hasattr(value, "is_linked"):
            tree.links.new(value, socket)
        elif value is not None:
            socket.default_value = value
    return node


def _math(tree, operation, *inputs):
    return _node(tree, "Math", *inputs, operation=operation).outputs[0]


def _property(tree, name):
    return _node(tree, "Attribute", attribute_name=name, attribute_type="OBJECT")


def _paint(material, number):
    """Colour and roughness from the robot's properties, so that no shader is built anew."""
    material.use_nodes = True
    material.cycles.emission_sampling = "NONE"
    tree = material.node_tree
    surface = tree.nodes["Principled BSDF"]
    colour = _property(tree, f"colour_{number}").outputs["Color"]
    finish = _node(tree, "SeparateXYZ", _property(tree, f"finish_{number}").outputs["Vector"])
    tree.links.new(colour, surface.inputs["Base Color"])
    tree.links.new(colour, surface.inputs["Emission Color"])
    tree.links.new(finish.outputs[0], surface.inputs["Roughness"])
    tree.links.new(finish.outputs[1], surface.inputs["Metallic"])
    tree.links.new(finish.outputs[2], surface.inputs["Emission Strength"])


def _show_blades(material, head):
    """Opacity of the discs: the share of the exposure in which a blade covers a point.

    "rotor" of a point is its place on the disc, x and y in metres, and the rotor's number;
    the robot has the first angle of rotor 0 and how far all turn while the shutter is open.
    """
    tree = material.node_tree
    place = _node(tree, "Attribute", attribute_name="rotor", attribute_type="GEOMETRY")
    x, y, number = _node(tree, "SeparateXYZ", place.outputs["Vector"]).outputs
    first = _property(tree, "rotor_first_rad").outputs["Fac"]
    sweep = _property(tree, "rotor_sweep_rad").outputs["Fac"]
    # Half a turn of two blades covers all there is to cover.
    sweep = _math(tree, "MINIMUM", _math(tree, "MAXIMUM", sweep, 0.02), math.pi)
    first = _math(tree, "ADD", first, _math(tree, "MULTIPLY", number, head["between_rotors_rad"]))
    angle = _math(tree, "SUBTRACT", _math(tree, "ARCTAN2", y, x), first)
    after = _math(tree, "FLOORED_MODULO", angle, math.pi)
    radius = _node(tree, "VectorMath", place.outputs["Vector"], (1, 1, 0), operation="MULTIPLY")
    radius = _node(tree, "VectorMath", radius.outputs[0], operation="LENGTH").outputs["Value"]
    half = _math(tree, "MAXIMUM", radius, 0.002)
    half = _math(tree, "DIVIDE", head["blade_half_width_m"], half)
    total = None
    for blade in (after, _math(tree, "SUBTRACT", after, math.pi)):
        end = _math(tree, "MINIMUM", _math(tree, "ADD", blade, half), sweep)
        begin = _math(tree, "MAXIMUM", _math(tree, "SUBTRACT", blade, half), 0.0)
        share = _math(tree, "MAXIMUM", _math(tree, "SUBTRACT", end, begin), 0.0)
        total = share if total is None else _math(tree, "ADD", total, share)
    opacity = _math(tree, "MINIMUM", _math(tree, "DIVIDE", total, sweep), 1.0)
    tree.links.new(opacity, tree.nodes["Principled BSDF"].inputs["Alpha"])


def _meshes(path):
    """Mesh and placement of every object of a file; of a .blend, without roots' own places.

    Importers turn y up into z up by the roots' rotation, so there it counts.
    """
    before = set(bpy.data.objects)
    kind = path.suffix.lower()
    if kind == ".blend":
        with bpy.data.libraries.load(str(path)) as (source, wanted):
            wanted.objects = source.objects
    elif kind in (".glb", ".gltf"):
        bpy.ops.import_scene.gltf(filepath=str(path))
    elif kind == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path))
    else:
        bpy.ops.wm.stl_import(filepath=str(path))
    found = [thing for thing in bpy.data.objects if thing not in before]
    bpy.context.view_layer.update()
    meshes = []
    for thing in found:
        if thing.type == "MESH":
            place = thing.matrix_world
            if kind == ".blend":
                root = thing
                while root.parent is not None:
                    root = root.parent
                place = root.matrix_world.inverted() @ place
            meshes.append((thing.data, place.copy()))
    for thing in found:
        bpy.data.objects.remove(thing)
    return meshes


def main():
    """Answer requests until the other side closes the pipe."""
    requests = sys.stdin.buffer
    # Blender chats on standard output: only our answers may go there.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    CyclesRender.render = _render_and_take
    stage = None
    while True:
        try:
            head, arrays = receive(requests)
        except EOFError:
            return
        if stage is None:
            try:
                stage = Stage(head, arrays)
            except (RuntimeError, ValueError, OSError) as error:
                why = " ".join(str(error).split())
                send(answers, {"error": f"{head['model']} is no model that Blender reads: {why}"})
                return
            send(answers, {"version": bpy.app.version_string}, {"points": stage.points()})
        elif "panorama" in head:
            send(answers, {}, {"panorama": _panorama(head["panorama"])})
        else:
            send(answers, {}, stage.shoot(head))


if __name__ == "__main__":
    main()
