# SPDX-License-Identifier: GPL-3.0-or-later
#
# Copyright (C) 2026 The dmrl developers
#
# This program is free software: you can redistribute it and/or modify it under the terms of
# the GNU General Public License as published by the Free Software Foundation, either version
# 3 of the License, or (at your option) any later version. It is distributed in the hope that
# it will be useful, but WITHOUT ANY WARRANTY; without even the implied warranty of
# MERCHANTABILITY or FITNESS FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
"""Helpers that create a shader node in one line."""


def add_node(tree, kind, *inputs, **options):
    """Create a node with its inputs linked or set, in order."""
    made = tree.nodes.new(f"ShaderNode{kind}")
    for name, value in options.items():
        setattr(made, name, value)
    for socket, value in zip(made.inputs, inputs, strict=False):
        if hasattr(value, "is_linked"):
            tree.links.new(value, socket)
        elif value is not None:
            socket.default_value = value
    return made


def add_math(tree, operation, *inputs):
    """Create a math node and return its output."""
    return add_node(tree, "Math", *inputs, operation=operation).outputs[0]


def add_property(tree, name):
    """Create a node that reads a property of the shaded object."""
    return add_node(tree, "Attribute", attribute_name=name, attribute_type="OBJECT")
