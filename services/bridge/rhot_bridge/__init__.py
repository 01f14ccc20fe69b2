"""Bridges: the rig's poses in the protocols and axes of other programs.

    bus ─▶ Feed ─▶ Newest ─▶ Pace ─▶ Scene in the target's axes ─▶ Target ─▶ Link ─▶ the other program

- `feed.Feed` (asyncio) subscribes and decodes once for all bridges of a process, and detects complete sets of samples.
- `newest.Newest` keeps the newest sample of each key and decides whether it is sent as it is, kept, faded or omitted.
- `pace.Pace` limits the rate without delaying a sample: one that comes too early is replaced by the next.
- `scene.Scene` holds what is sent as plain arrays, in the axes of `axes`.
- `targets.Target` is one other program: `frame(scene)` returns packets (bytes); no socket, no clock, no asyncio.
- `links.Link` sends packets: `UdpLink`, `WebSocketLink`. It never blocks; a missing receiver is logged once.

A new target is one module in `targets/` and one line in `targets.TARGETS`. A target whose library does the sending
(LSL, ROS 2) needs no link: its `make_output(config)` returns its own `output.Output`.
"""
