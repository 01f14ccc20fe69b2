"""Listens to VMC with the package vmcp until all bones are there, 20 s at most: vmc.py PORT COUNT > JSON."""

import json
import sys
import time

from vmcp.events import BoneTransformEvent
from vmcp.facades import on_receive
from vmcp.osc import OSC
from vmcp.osc.backend.osc4py3 import as_eventloop as backend

port, count = int(sys.argv[1]), int(sys.argv[2])
found: dict[str, list[float]] = {}


def keep(event: BoneTransformEvent) -> None:
    p, q = event.position, event.rotation
    found[event.joint.value] = [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


channels = OSC(backend)
with channels.open():
    on_receive(channels.create_receiver("127.0.0.1", port, "reader").open(), BoneTransformEvent, keep)
    sys.stderr.write("listening\n")
    sys.stderr.flush()
    end = time.monotonic() + 20.0
    while len(found) < count and time.monotonic() < end:
        channels.run()
        time.sleep(0.01)
json.dump(found, sys.stdout)
