"""Opens a file in Blender and prints where its bones and empties are: blender.py FILE SECONDS > JSON."""

import json
import sys

import bpy  # type: ignore[import-not-found]

path, seconds = sys.argv[1], float(sys.argv[2])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = 60
if path.endswith(".bvh"):
    # The file says centimetres and y up; Blender has metres and z up.
    bpy.ops.import_anim.bvh(
        filepath=path, global_scale=0.01, axis_forward="-Z", axis_up="Y", update_scene_fps=True, use_fps_scale=False
    )
    first = 1
else:
    bpy.ops.import_scene.gltf(filepath=path)
    first = 0
fps = scene.render.fps / scene.render.fps_base
scene.frame_set(round(first + seconds * fps))
found = {}
for thing in scene.objects:
    if thing.type == "ARMATURE":
        for bone in thing.pose.bones:
            found[bone.name] = list(thing.matrix_world @ bone.head)
    else:
        found[thing.name] = list(thing.matrix_world.translation)
# From Blender's axes back to ours: y up, −z forward.
json.dump({name: [x, z, -y] for name, (x, y, z) in found.items()}, sys.stdout)
