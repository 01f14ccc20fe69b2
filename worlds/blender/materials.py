"""Blender materials of a world; needs `bpy`."""

from __future__ import annotations

from typing import Any

import bpy  # type: ignore[import-not-found]

from worlds.look import Colour, Paint

MASKS = ("maskA", "maskB")
"""Render outputs whose red, green and blue tell thumb, index, middle and ring, little, base apart."""


def plain(name: str, colour: Colour, roughness: float = 0.6, metallic: float = 0.0, speckle: float = 0.08) -> Any:
    """Return a material of one colour with faint speckles."""
    material, nodes, links = _new(name)
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Metallic"].default_value = metallic
    _mottled(nodes, links, colour, shader.inputs["Base Color"], 14.0, speckle, "Object")
    return material


def desk(kind: str, colour: Colour) -> Any:
    """Return the material of the desk."""
    material, nodes, links = _new("desk")
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = {"cloth": 0.95, "mat": 0.8, "wood": 0.4, "bright": 0.5}[kind]
    if kind == "wood":
        coordinates = nodes.new("ShaderNodeTexCoord")
        stretch = nodes.new("ShaderNodeMapping")
        stretch.inputs["Scale"].default_value = (0.09, 1.1, 1.0)
        stretch.inputs["Rotation"].default_value = (0.0, 0.0, 0.2)
        links.new(coordinates.outputs["Object"], stretch.inputs["Vector"])
        grain = nodes.new("ShaderNodeTexNoise")
        grain.inputs["Scale"].default_value = 3.0
        grain.inputs["Detail"].default_value = 8.0
        grain.inputs["Distortion"].default_value = 0.6
        links.new(stretch.outputs["Vector"], grain.inputs["Vector"])
        ramp = nodes.new("ShaderNodeValToRGB")
        for place, element in enumerate(ramp.color_ramp.elements):
            element.position = (0.3, 0.7)[place]
            element.color = (*(c * (0.55, 1.25)[place] for c in colour), 1.0)
        links.new(grain.outputs["Fac"], ramp.inputs["Fac"])
        links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
        return material
    scale, share = {"cloth": (6.0, 0.35), "mat": (2.0, 0.15), "bright": (1.0, 0.05)}[kind]
    _mottled(nodes, links, colour, shader.inputs["Base Color"], scale, share, "Object")
    if kind != "bright":
        _bump(nodes, links, shader, 60.0, 0.4 if kind == "cloth" else 0.15, "Object")
    return material


def skin(colour: Colour, paint: Paint | None = None, mask: int = 0) -> Any:
    """Return skin, with paint where the attribute `beyond` is positive when a paint is given.

    Args:
        colour: of the skin.
        paint: of the fingertip.
        mask: which marker the paint is, an index into `MARKERS`.
    """
    material, nodes, links = _new("skin" if paint is None else f"skin {paint.name}")
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = 0.5
    shader.inputs["Subsurface Weight"].default_value = 0.0
    _mottled(nodes, links, colour, shader.inputs["Base Color"], 9.0, 0.16, "Generated")
    _bump(nodes, links, shader, 45.0, 0.25, "Generated")
    if paint is None:
        return material
    coat = nodes.new("ShaderNodeBsdfPrincipled")
    coat.inputs["Roughness"].default_value = paint.roughness
    _mottled(nodes, links, paint.colour, coat.inputs["Base Color"], 30.0, 0.08, "Generated")
    attribute = nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = "beyond"
    edge = nodes.new("ShaderNodeMath")
    edge.operation = "GREATER_THAN"
    edge.inputs[1].default_value = 0.0
    links.new(attribute.outputs["Fac"], edge.inputs[0])
    mix = nodes.new("ShaderNodeMixShader")
    links.new(edge.outputs[0], mix.inputs[0])
    links.new(shader.outputs[0], mix.inputs[1])
    links.new(coat.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], nodes["Material Output"].inputs["Surface"])
    _tell(nodes, links, mask, edge.outputs[0])
    return material


def patch(paint: Paint) -> Any:
    """Return the material of the patch on the back of the hand."""
    material = plain("patch", paint.colour, paint.roughness)
    _tell(material.node_tree.nodes, material.node_tree.links, 5, None)
    return material


def _new(name: str) -> tuple[Any, Any, Any]:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    return material, material.node_tree.nodes, material.node_tree.links


def _noise(nodes: Any, links: Any, scale: float, coordinates: str) -> Any:
    where = nodes.new("ShaderNodeTexCoord")
    noise = nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = scale
    noise.inputs["Detail"].default_value = 5.0
    links.new(where.outputs[coordinates], noise.inputs["Vector"])
    return noise


def _mottled(nodes: Any, links: Any, colour: Colour, target: Any, scale: float, share: float, coordinates: str) -> None:
    noise = _noise(nodes, links, scale, coordinates)
    ramp = nodes.new("ShaderNodeValToRGB")
    for place, element in enumerate(ramp.color_ramp.elements):
        element.position = (0.25, 0.75)[place]
        element.color = (*(min(c * (1.0 + share * (-1.0, 1.0)[place]), 1.0) for c in colour), 1.0)
    links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], target)


def _bump(nodes: Any, links: Any, shader: Any, scale: float, strength: float, coordinates: str) -> None:
    noise = _noise(nodes, links, scale, coordinates)
    bump = nodes.new("ShaderNodeBump")
    bump.inputs["Strength"].default_value = strength
    bump.inputs["Distance"].default_value = 0.01
    links.new(noise.outputs["Fac"], bump.inputs["Height"])
    links.new(bump.outputs["Normal"], shader.inputs["Normal"])


def _tell(nodes: Any, links: Any, marker: int, value: Any) -> None:
    """Write 1 (or a value) into the mask output of a marker."""
    colour = nodes.new("ShaderNodeCombineColor")
    for place in range(3):
        colour.inputs[place].default_value = 0.0
    if value is None:
        colour.inputs[marker % 3].default_value = 1.0
    else:
        links.new(value, colour.inputs[marker % 3])
    out = nodes.new("ShaderNodeOutputAOV")
    out.aov_name = MASKS[marker // 3]
    links.new(colour.outputs[0], out.inputs["Color"])
