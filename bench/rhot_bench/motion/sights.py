"""What one camera publishes of a painted hand in motion: marker frames as capture makes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray, IntArray
from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame
from rhot_bench.motion.hand_motion import HandMotion
from rhot_bench.motion.painted import Flesh, Surface, seen_samples
from rhot_bench.motion.rigs import RigDraw
from rhot_bench.motion.skin import skin_sides
from rhot_bench.motion.truth import MARKERS, START_NS, marker_frames_of

MarkerKind = Literal["caps", "points"]

_LEAST_SHARE: Final = 0.08
"""Share of its facing paint below which a marker is no blob of its own colour; capture's size gate acts beside it."""
_CORNER_TIMES: Final = 2.0
"""Corners of the patch are found this much less surely than a centroid; measured on G1: 0.2 px beside 0.1."""
_WHOLE_SHARE: Final = 0.97
"""Share of its paint from which capture tells the corners of a patch."""


@dataclass(frozen=True, slots=True)
class CameraSights:
    """One camera's clip.

    Attributes:
        frames: marker frames, without the lost ones.
        t_ns: (F,) mid-exposure of the middle row of every frame, lost ones included.
        visible: (F, 6) whether the marker was a blob in that frame.
        whole: (F, 6) share of its facing paint that nothing hides.
    """

    frames: list[MarkerFrame]
    t_ns: IntArray
    visible: NDArray[np.bool_]
    whole: FloatArray


@dataclass(frozen=True, slots=True)
class _MarkerViews:
    """One marker in all F frames of a camera.

    Attributes:
        t_ns: (F,) mid-exposure of its own row.
        uv: (F, 2) measured centre, pixels.
        area: (F,) visible, square pixels.
        share: (F,) of its facing paint that nothing hides.
        corners: (F, 4, 2) measured, pixels; none but of the patch.
        skin_side: (F, 2) where skin adjoins; none of the patch.
    """

    t_ns: IntArray
    uv: FloatArray
    area: FloatArray
    share: FloatArray
    corners: FloatArray | None
    skin_side: FloatArray | None


def camera_sights(
    rng: np.random.Generator,
    number: int,
    name: str,
    draw: RigDraw,
    motion: HandMotion,
    surfaces: Sequence[Surface],
    flesh: Flesh,
    gate_px: Sequence[float],
    kind: MarkerKind,
) -> CameraSights:
    """Return what a camera sees of a clip; the arguments are those of `make_tracks`, and what it drew."""
    camera = draw.true[name]
    period_s = 1.0 / draw.rate_hz
    half_s = 0.5 * (draw.exposure_s + draw.readout_s)
    first_s = np.arange(draw.phases[number] * period_s, motion.seconds - 2.0 * half_s, period_s)
    count = len(first_s)
    visible, whole = np.zeros((count, len(MARKERS)), dtype=bool), np.zeros((count, len(MARKERS)))
    lost = rng.random(count) < draw.lost
    found: list[dict[str, dict[str, object]]] = [{} for _ in range(count)]
    for marker, label in enumerate(MARKERS):
        views = _marker_views(rng, camera, first_s, draw, motion, surfaces, flesh, marker, kind)
        inside = camera.contains(np.nan_to_num(views.uv, nan=-1e6))
        visible[:, marker] = inside & (views.area > gate_px[marker]) & (views.share > _LEAST_SHARE)
        whole[:, marker] = views.share
        for frame in np.flatnonzero(visible[:, marker] & ~lost).tolist():
            found[frame][label] = _published(views, frame, camera, rolling=draw.readout_s > 0.0)
    t_ns = START_NS + np.round(1e9 * (first_s + half_s)).astype(np.int64)
    frames = [
        MarkerFrame.model_validate(
            {
                "t_ns": int(t_ns[frame]),
                "seq": frame,
                "camera": name,
                "width": camera.width,
                "height": camera.height,
                "markers": found[frame],
                "frame": frame,
            }
        )
        for frame in np.flatnonzero(~lost).tolist()
    ]
    return CameraSights(frames, t_ns, visible, whole)


def _marker_views(
    rng: np.random.Generator,
    camera: CameraModel,
    first_s: FloatArray,
    draw: RigDraw,
    motion: HandMotion,
    surfaces: Sequence[Surface],
    flesh: Flesh,
    marker: int,
    kind: MarkerKind,
) -> _MarkerViews:
    """Return a marker as a camera measures it in frames whose first rows are exposed from `first_s` (F,) on."""
    count, surface = len(first_s), surfaces[marker]
    t_s = _row_times(camera, first_s, draw, motion, surface, marker)
    hand = motion.at(t_s)
    origin, R = marker_frames_of(hand, marker)
    points = origin[:, None] + surface.points @ np.swapaxes(R, 1, 2)
    normals = surface.normals @ np.swapaxes(R, 1, 2)
    is_patch = marker == len(FINGERS)
    capsules = flesh.capsules(hand)
    facing, shown = seen_samples(points, normals, camera.center, capsules, -1 if is_patch else marker)
    depth = camera.to_camera(points.reshape(-1, 3))[:, 2].reshape(count, -1)
    to_px = float(camera.K[0, 0] * camera.K[1, 1]) * surface.areas / depth**2
    area, full = (shown * to_px).sum(axis=1), (facing * to_px).sum(axis=1)
    corners, skin_side = None, None
    if kind == "points":
        uv = camera.project(origin + R @ surface.centre)
    else:
        every = camera.project(points.reshape(-1, 3)).reshape(count, -1, 2)
        uv = ((shown * to_px)[..., None] * every).sum(axis=1) / np.maximum(area, 1e-9)[:, None]
        if not is_patch:
            skin_side = skin_sides(camera, uv, every, depth, shown, capsules, surfaces[: len(FINGERS)])
    # Drawn for every marker, so that no clip depends on which one is the patch.
    noise = rng.normal(0.0, draw.noise_px, (count, 2))
    corner_noise = rng.normal(0.0, _CORNER_TIMES * draw.noise_px, (count, 4, 2))
    if is_patch:
        true_corners = camera.project(_patch_corners(surface, origin, R).reshape(-1, 3)).reshape(count, 4, 2)
        corners = true_corners + corner_noise
    t_ns = START_NS + np.round(1e9 * t_s).astype(np.int64)
    return _MarkerViews(t_ns, uv + noise, area, area / np.maximum(full, 1e-9), corners, skin_side)


def _published(views: _MarkerViews, frame: int, camera: CameraModel, *, rolling: bool) -> dict[str, object]:
    """Return the fields of a `Marker`; rows of a rolling shutter have a time of their own."""
    u, v = views.uv[frame].tolist()
    share = float(views.share[frame])
    fields: dict[str, object] = {"u": u, "v": v, "area": float(views.area[frame]), "score": 0.5 + 0.5 * share}
    fields["t_ns"] = int(views.t_ns[frame]) if rolling else None
    if views.skin_side is not None:
        fields["skin_side"] = tuple(views.skin_side[frame].tolist())
    if views.corners is not None and share > _WHOLE_SHARE and camera.contains(views.corners[frame]).all():
        fields["corners"] = tuple(map(tuple, _clockwise(views.corners[frame]).tolist()))
    return fields


def _row_times(
    camera: CameraModel, first_s: FloatArray, draw: RigDraw, motion: HandMotion, surface: Surface, marker: int
) -> FloatArray:
    """Return mid-exposure (F,) of a marker's own row, seconds: t = first + read-out·v/(H−1) + exposure/2."""
    t_s = first_s + 0.5 * (draw.exposure_s + draw.readout_s)
    # A marker moves by less than a row within the last correction after two rounds.
    for _ in range(2 if draw.readout_s > 0.0 else 0):
        origin, R = marker_frames_of(motion.at(t_s), marker)
        row = camera.project(origin + R @ surface.centre)[:, 1]
        share = np.clip(np.nan_to_num(row, nan=0.0) / (camera.height - 1), 0.0, 1.0)
        t_s = first_s + draw.readout_s * share + 0.5 * draw.exposure_s
    return t_s


def _patch_corners(surface: Surface, origin: FloatArray, R: FloatArray) -> FloatArray:
    """Return the corners (N, 4, 3) of a patch, metres."""
    # The samples fill the patch evenly: 8 across by 6 along, half a step inside of its edges.
    grid = surface.points.reshape(8, 6, 3)
    across, along = (grid[-1, 0] - grid[0, 0]) * 8.0 / 7.0, (grid[0, -1] - grid[0, 0]) * 6.0 / 5.0
    signs = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    corners: FloatArray = origin[:, None] + (surface.centre + signs @ np.stack([across, along])) @ np.swapaxes(R, 1, 2)
    return corners


def _clockwise(corners: FloatArray) -> FloatArray:
    """Return corners (4, 2) clockwise as seen, beginning at the one nearest to the picture's upper left."""
    a, b = corners[1] - corners[0], corners[3] - corners[0]
    ordered = corners if a[0] * b[1] - a[1] * b[0] > 0.0 else corners[::-1]
    return np.roll(ordered, -int(np.argmin(ordered.sum(axis=1))), axis=0)
