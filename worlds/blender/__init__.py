"""Worlds as Blender scenes and their pictures; these modules need `bpy`, `exr` alone does not."""
