"""Hands of a RHOT rig in Blender. Start `rhot bridge json --transport udp`, run this in Blender's Text editor.

Each joint is an empty named "left 1", "right 10", …, in OpenXR's order (0 palm, 1 wrist, 2 thumb, …), so that bones can
follow them by constraints. Run it again to stop.
"""

import json
import socket

import bpy
from mathutils import Matrix, Quaternion, Vector

PORT = 8766
# Stage (y up, -z forward) to Blender (z up, y forward).
UP = Matrix(((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)))


def empty(name):
    """Return the empty of a joint."""
    found = bpy.data.objects.get(name)
    if found is None:
        found = bpy.data.objects.new(name, None)
        found.empty_display_type = "SPHERE"
        found.rotation_mode = "QUATERNION"
        bpy.context.scene.collection.objects.link(found)
    return found


def update():
    """Show the newest frame; called again and again by Blender."""
    running = bpy.app.driver_namespace.get("rhot")
    if running is not receiver:
        receiver.close()
        return None
    newest = None
    try:
        while True:
            newest = receiver.recv(65536)
    except BlockingIOError:
        pass
    for hand in json.loads(newest)["hands"] if newest else ():
        p, q = hand["positions"], hand["orientations"]
        for k in range(26):
            x, y, z, w = q[4 * k : 4 * k + 4]
            joint = empty(f"{hand['side']} {k}")
            joint.location = UP @ Vector(p[3 * k : 3 * k + 3])
            joint.rotation_quaternion = (UP @ Quaternion((w, x, y, z)).to_matrix()).to_quaternion()
            joint.empty_display_size = hand["radii"][k]
    return 1 / 60


if bpy.app.driver_namespace.pop("rhot", None) is None:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", PORT))
    receiver.setblocking(False)
    bpy.app.driver_namespace["rhot"] = receiver
    bpy.app.timers.register(update)
