"""The bridges: what the rig tracks, in the words and axes of other programs.

    bus ─▶ Feed ─▶ Newest ─▶ Pace ─▶ Scene in the target's axes ─▶ Target ─▶ Link ─▶ the other program

- `feed.Feed` (asyncio) subscribes and decodes once for all bridges of a process, and says when a moment is complete.
- `newest.Newest` keeps the newest of each key and says what of it goes out: as it is, kept, faded, or not at all.
- `pace.Pace` caps the rate without ever holding a sample back: what is too early is replaced by the next one.
- `scene.Scene` is what goes out: plain arrays, in the axes of `axes`.
- `targets.Target` is one other program: `frame(scene)` returns packets, bytes alone; no socket, no clock, no asyncio.
- `links.Link` brings packets there: `UdpLink`, `WebSocketLink`. It never blocks, and a receiver that is not there
  costs nothing and is told once.

A further target is one module in `targets/` and one line in `targets.TARGETS`. One whose library does the sending
itself (LSL, ROS 2) needs no link: its `make_output(config)` returns an `output.Output` of its own.
"""
