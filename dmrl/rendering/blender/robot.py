# SPDX-License-Identifier: GPL-3.0-or-later
#
# Copyright (C) 2026 The dmrl developers
#
# This program is free software: you can redistribute it and/or modify it under the terms of
# the GNU General Public License as published by the Free Software Foundation, either version
# 3 of the License, or (at your option) any later version. It is distributed in the hope that
# it will be useful, but WITHOUT ANY WARRANTY; without even the implied warranty of
# MERCHANTABILITY or FITNESS FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
"""Mesh of the robot: the built-in one, or the user's model."""

import math

import bpy
import numpy as np
from nodes import add_math, add_node, add_property

ROTATED_SUFFIXES = (".glb", ".gltf", ".obj")


def build_mesh(head, arrays):
    """Build the mesh of the built-in robot: vertices in metres, triangles with a material each."""
    mesh = bpy.data.meshes.new("robot")
    mesh.from_pydata(arrays["vertices"].tolist(), [], arrays["faces"].tolist())
    mesh.polygons.foreach_set("material_index", arrays["material"].astype(np.int32))
    polar = mesh.attributes.new("rotor", "FLOAT_VECTOR", "POINT")
    polar.data.foreach_set("vector", arrays["rotor"].astype(np.float32).ravel())
    for k, name in enumerate(head["materials"]):
        material = bpy.data.materials.new(name)
        _build_material(material, k)
        if name == "rotor":
            _add_rotor_blur(material, head)
        mesh.materials.append(material)
    mesh.update()
    return mesh


def load_mesh(path, scale, up, *, boxed):
    """Load the user's model as one mesh, centred on its bounding box or on the file's origin."""
    meshes = _extract_meshes(path)
    _require_textures(meshes)
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
    points = _rotate_upright(points, path.suffix.lower(), up)
    if boxed:
        points -= (points.min(axis=0) + points.max(axis=0)) / 2
    robot.from_pydata(points.tolist(), [], faces)
    robot.polygons.foreach_set("material_index", np.array(indices, np.int32))
    _copy_texture_coordinates([mesh for mesh, _ in meshes], robot)
    robot.update()
    return robot


def _copy_texture_coordinates(meshes, robot):
    """Copy the coordinates of every triangle's corners, by name; a mesh without it gives its own.

    Materials find coordinates by name, or take the first.
    """
    names = list(dict.fromkeys(layer.name for mesh in meshes for layer in mesh.uv_layers))
    for name in names:
        parts = []
        for mesh in meshes:
            corners = [corner for t in mesh.loop_triangles for corner in t.loops]
            layer = mesh.uv_layers.get(name) or mesh.uv_layers.active
            given = np.zeros((len(mesh.loops), 2), np.float32)
            if layer is not None:
                layer.data.foreach_get("uv", given.ravel())
            parts.append(given[corners])
        target = robot.uv_layers.new(name=name)
        target.data.foreach_set("uv", np.concatenate(parts).ravel())


def _require_textures(meshes):
    """Raise ValueError if a texture is missing: Blender paints such surfaces magenta."""
    materials = {material for mesh, _ in meshes for material in mesh.materials if material}
    for material in sorted(materials, key=lambda material: material.name):
        for node in material.node_tree.nodes if material.node_tree else ():
            image = getattr(node, "image", None)
            used = any(output.is_linked for output in node.outputs)
            if used and image is not None and image.source == "FILE" and not all(image.size):
                raise ValueError(f"its texture {image.name} is missing")


def _rotate_upright(points, kind, up):
    """Rotate points to z up, from the file's axis ``up``. auto uses the convention of its format.

    Blender's importers already rotate .obj and .glb, whose y is up by convention.
    """
    x, y, z = points.T
    if kind in ROTATED_SUFFIXES:
        return np.column_stack([x, z, -y]) if up == "z" else points
    return np.column_stack([x, -z, y]) if up == "y" else points


def _build_material(material, number):
    """Create a material that reads its paint from object properties: no shader is rebuilt."""
    material.use_nodes = True
    material.cycles.emission_sampling = "NONE"
    tree = material.node_tree
    surface = tree.nodes["Principled BSDF"]
    colour = add_property(tree, f"colour_{number}").outputs["Color"]
    finish = add_node(tree, "SeparateXYZ", add_property(tree, f"finish_{number}").outputs["Vector"])
    tree.links.new(colour, surface.inputs["Base Color"])
    tree.links.new(colour, surface.inputs["Emission Color"])
    tree.links.new(finish.outputs[0], surface.inputs["Roughness"])
    tree.links.new(finish.outputs[1], surface.inputs["Metallic"])
    tree.links.new(finish.outputs[2], surface.inputs["Emission Strength"])
    # No material is brushed metal: a constant tangent avoids computing one for every ray.
    tree.links.new(add_node(tree, "CombineXYZ").outputs[0], surface.inputs["Tangent"])


def _add_rotor_blur(material, head):
    """Set the opacity of rotor discs: the share of the exposure in which a blade covers a point.

    The attribute "rotor" of a point is its place on the disc, x and y in metres, and the rotor's
    number. The robot has the first angle of rotor 0 and the rotation during the exposure.
    """
    tree = material.node_tree
    place = add_node(tree, "Attribute", attribute_name="rotor", attribute_type="GEOMETRY")
    x, y, number = add_node(tree, "SeparateXYZ", place.outputs["Vector"]).outputs
    first = add_property(tree, "rotor_first_rad").outputs["Fac"]
    sweep = add_property(tree, "rotor_sweep_rad").outputs["Fac"]
    # Half a turn of two blades covers the whole disc.
    sweep = add_math(tree, "MINIMUM", add_math(tree, "MAXIMUM", sweep, 0.02), math.pi)
    turn = add_math(tree, "MULTIPLY", number, head["between_rotors_rad"])
    first = add_math(tree, "ADD", first, turn)
    angle = add_math(tree, "SUBTRACT", add_math(tree, "ARCTAN2", y, x), first)
    after = add_math(tree, "FLOORED_MODULO", angle, math.pi)
    radius = add_node(tree, "VectorMath", place.outputs["Vector"], (1, 1, 0), operation="MULTIPLY")
    radius = add_node(tree, "VectorMath", radius.outputs[0], operation="LENGTH").outputs["Value"]
    half = add_math(tree, "MAXIMUM", radius, 0.002)
    half = add_math(tree, "DIVIDE", head["blade_half_width_m"], half)
    total = None
    for blade in (after, add_math(tree, "SUBTRACT", after, math.pi)):
        end = add_math(tree, "MINIMUM", add_math(tree, "ADD", blade, half), sweep)
        begin = add_math(tree, "MAXIMUM", add_math(tree, "SUBTRACT", blade, half), 0.0)
        share = add_math(tree, "MAXIMUM", add_math(tree, "SUBTRACT", end, begin), 0.0)
        total = share if total is None else add_math(tree, "ADD", total, share)
    opacity = add_math(tree, "MINIMUM", add_math(tree, "DIVIDE", total, sweep), 1.0)
    # A mix shader skips the side whose share is 0. Alpha would evaluate both.
    clear = add_node(tree, "BsdfTransparent").outputs[0]
    blade = tree.nodes["Principled BSDF"].outputs[0]
    mixture = add_node(tree, "MixShader", opacity, clear, blade).outputs[0]
    tree.links.new(mixture, tree.nodes["Material Output"].inputs["Surface"])


def _extract_meshes(path):
    """Return mesh and placement of every object of a file.

    The placement of a .blend is relative to the root object. Other importers convert y up to z up
    by the root's rotation, which is therefore kept.
    """
    kind, meshes = path.suffix.lower(), []
    things = _import_objects(path, kind)
    for thing in things:
        if thing.type == "MESH":
            place = thing.matrix_world
            if kind == ".blend":
                place = _root_object(thing).matrix_world.inverted() @ place
            meshes.append((thing.data, place.copy()))
    for thing in things:
        bpy.data.objects.remove(thing)
    return meshes


def _import_objects(path, kind):
    """Import all objects of a file with updated matrices."""
    before = set(bpy.data.objects)
    if kind == ".blend":
        with bpy.data.libraries.load(str(path)) as (source, wanted):
            wanted.objects = source.objects
    elif kind in (".glb", ".gltf"):
        bpy.ops.import_scene.gltf(filepath=str(path))
    elif kind == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path))
    else:
        bpy.ops.wm.stl_import(filepath=str(path))
    bpy.context.view_layer.update()
    return [thing for thing in bpy.data.objects if thing not in before]


def _root_object(thing):
    """Return the topmost parent of an object, or the object itself."""
    while thing.parent is not None:
        thing = thing.parent
    return thing
