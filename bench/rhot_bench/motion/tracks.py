"""What the cameras of one rig see of one clip, as marker frames that capture would publish, and the truth beside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import BoolArray, FloatArray, IntArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import nearest_rotation, rotation_from_vector, rotation_z
from rhot.messages import MarkerFrame
from rhot.rig import HandFile, Rig
from rhot.rig.calibration import WIDTH_OVER_LENGTH, today
from rhot_bench.motion.painted import (
    MARKERS,
    START_NS,
    Capsules,
    Flesh,
    Surface,
    Truth,
    cap_surface,
    marker_frames_of,
    nearest,
    patch_surface,
    seen_samples,
)
from rhot_bench.motion.recordings import HandMotion, RecordedHand, list_recordings, read_recording
from rhot_bench.motion.rigs import Family, RigDraw, draw_rig, write_rig

# What one camera publishes of a painted hand in motion: marker frames as capture makes them.

# Where skin adjoins the paint of a fingertip in an image, as capture states it (`Marker.skin_side`).
#
# Around the blob, as far outside as capture looks, rays are cast. One sees skin when it meets a finger or the palm
# before the object in the hand, and that not where another cap is painted.

_DIRECTIONS: Final = 16
_OUTSIDE_PX: Final = 3.5
"""Capture's ring is 2.5 to 4.5 pixels outside of the paint."""
_SPACING_M: Final = 0.001
"""The paint reaches about so much further than the middle of its outermost sample."""


def skin_sides(
    camera: CameraModel,
    uv: FloatArray,
    pixels: FloatArray,
    depth_m: FloatArray,
    shown: FloatArray,
    capsules: Capsules,
    caps: Sequence[Surface],
) -> FloatArray:
    """Return the mean (N, 2) over a ring around a blob of the unit vectors to skin, those to anything else counting 0.

    Args:
        camera: that sees it.
        uv: (N, 2) its centroid, pixels.
        pixels: (N, S, 2) samples of its paint.
        depth_m: (N, S) their depths.
        shown: (N, S) > 0 where the camera sees them.
        capsules: of the N moments.
        caps: of the five fingers.
    """
    count = len(uv)
    turns = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    directions = np.column_stack([np.cos(turns), np.sin(turns)])
    reach = np.where(shown[..., None] > 0.0, (pixels - uv[:, None]) @ directions.T, 0.0).max(axis=1)
    reach += (_OUTSIDE_PX + _SPACING_M * camera.K[0, 0] / depth_m[:, 0])[:, None]
    ring = uv[:, None] + reach[..., None] * directions
    rays = camera.rays(ring.reshape(-1, 2)).reshape(count, _DIRECTIONS, 3)
    sides: FloatArray = (_sees_skin(camera.center, rays, capsules, caps)[..., None] * directions).mean(axis=1)
    return sides


def _sees_skin(eye: FloatArray, rays: FloatArray, capsules: Capsules, caps: Sequence[Surface]) -> BoolArray:
    """Tell which rays (N, D, 3) from the camera's centre (3,) meet skin first."""
    first_m = np.full(rays.shape[:2], np.inf)
    skin = np.zeros(rays.shape[:2], dtype=bool)
    for number, radius in enumerate(capsules.radius.tolist()):
        begin, end = capsules.begin[:, number], capsules.end[:, number]
        ahead, share, apart2 = nearest(eye, rays, begin, end)
        # The distance of the nearest point of the axis, less what the radius leaves, tells bones apart that lie behind
        # each other.
        met_m = np.where(apart2 < radius**2, ahead - np.sqrt(np.maximum(radius**2 - apart2, 0.0)), np.inf)
        first = met_m < first_m
        first_m = np.where(first, met_m, first_m)
        # `Flesh.capsules` begins with fifteen bones of fingers and four of the palm; what is held comes
        # after.
        is_skin = np.full(first.shape, number < 19)
        finger = int(capsules.finger[number])
        if finger >= 0:
            # The capsule ends one radius before the very tip, from where the paint's length counts.
            from_tip_m = radius + (1.0 - share) * np.linalg.norm(end - begin, axis=1)[:, None]
            painted = caps[finger].points[:, 2]
            is_skin = (from_tip_m > painted.max() + _SPACING_M) | (from_tip_m < painted.min() - _SPACING_M)
        skin = np.where(first, is_skin, skin)
    return skin


# What one camera publishes of a painted hand in motion: marker frames as capture makes them.

MarkerKind = Literal["caps", "bands", "points"]

_BARE_M: Final = 0.003
"""What a tape around a finger leaves bare of its end."""

_LEAST_SHARE: Final = 0.08
"""Share of its facing paint below which a marker is no blob of its own colour; capture's size gate acts beside it."""


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
    # Corners of the patch are found this much less surely than a centroid; measured on G1: 0.2 px beside 0.1.
    corner_noise = rng.normal(0.0, 2.0 * draw.noise_px, (count, 4, 2))
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
    # Share of its paint from which capture tells the corners of a patch.
    if views.corners is not None and share > 0.97 and camera.contains(views.corners[frame]).all():
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


# The hand that is worn on a rig: a clip of a recording, and flesh, paint, patch and object, drawn at random.

_FLESH_MM: Final = ((9.5, 9.5, 8.8), (9.5, 8.5, 7.6), (9.5, 8.6, 7.8), (9.0, 8.0, 7.3), (8.0, 7.2, 6.6))
"""Radii of the moving bones of a hand of 185 mm, thumb first; the means of `hand_proportions.RADII_MM` along each."""


def draw_clip(rng: np.random.Generator, data: Path, seconds: float, draw: RigDraw) -> tuple[HandMotion, str, bool]:
    """Return a clip of a recording, placed before the cameras with the back of the hand towards them, more or less."""
    sources = list_recordings(data)
    source = str(rng.choice(list(sources)))
    hand: RecordedHand = read_recording(sources[source][rng.integers(len(sources[source]))], source)
    seconds = min(seconds, hand.seconds - 0.1)
    start_s = float(rng.uniform(0.0, hand.seconds - seconds))
    radii = 1e-3 * np.array([row[2] for row in _FLESH_MM])
    motion = HandMotion(hand, start_s, seconds, float(rng.uniform(0.92, 1.08)), radii)
    middle = motion.at(np.linspace(0.0, seconds, 30))
    # The mean hand lies with its back to the cameras; people hold it up to 35° off, and turned any way in the picture.
    mean = nearest_rotation(middle.R.sum(axis=0))
    flat = np.column_stack([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    tilt = rotation_from_vector(np.radians(rng.uniform(-25.0, 25.0, 3)) * [1.0, 1.0, 0.0])
    R = rotation_z(float(np.radians(rng.uniform(-60.0, 60.0)))) @ tilt @ flat @ mean.T
    lenses = np.mean([camera.center for camera in draw.true.values()], axis=0)
    target = np.array([lenses[0], lenses[1], draw.distance_m]) + rng.uniform(-0.03, 0.03, 3)
    motion.place(R, target - R @ middle.joints[:, JOINTS.index("middle_proximal")].mean(axis=0))
    return motion, hand.name, hand.grasps


def draw_hand(
    rng: np.random.Generator, motion: HandMotion, grasps: bool, bare_m: float = 0.0
) -> tuple[Flesh, list[Surface], HandFile, tuple[float, float]]:
    """Return flesh, paint and patch of a hand, and what two measures by a ruler tell of it.

    Fingers stay bare from the very tip for `bare_m`.
    """
    hand_m = 0.185
    scale = motion.length_m / hand_m * float(rng.uniform(0.92, 1.12))
    bones_m = np.minimum(1e-3 * scale * np.array(_FLESH_MM), 0.45 * motion.bones[:, 2:])
    bones_m[:, 2] = np.minimum(bones_m[:, 2], bones_m[:, 1])
    tips = bones_m[:, 2]
    motion.tip_radius_m = tips
    lengths = rng.uniform(0.012, 0.022, 5) * scale
    surfaces = [
        cap_surface(max(float(length), 1.2 * float(r)), float(r), float(r) * float(rng.uniform(1.0, 1.15)), bare_m)
        for length, r in zip(lengths, tips, strict=True)
    ]
    patch_m = (float(rng.uniform(0.030, 0.045)), float(rng.uniform(0.022, 0.032)))
    patch = patch_surface(patch_m)
    tilt = rotation_from_vector(np.radians(rng.normal(0.0, 4.0, 3)))
    to_fingers = motion.knuckles[2] / np.linalg.norm(motion.knuckles[2])
    middle = to_fingers * rng.uniform(0.020, 0.045) + [rng.uniform(-0.005, 0.005), scale * rng.uniform(0.012, 0.018), 0]
    surfaces.append(Surface(patch.points @ tilt.T + middle, patch.normals @ tilt.T, patch.areas, middle))
    palm = np.full(4, 0.011 * scale)
    flesh = Flesh(bones_m, palm, np.zeros(3), np.zeros(3), 0.0)
    if grasps:
        flesh = _with_object(rng, motion, flesh)
    length = motion.length_m + float(rng.normal(0.0, 0.0015))
    across = float(np.linalg.norm(motion.knuckles[1] - motion.knuckles[4])) + 0.024 * scale
    measured = ruler_measures(length, across + float(rng.normal(0.0, 0.0015)))
    return flesh, surfaces, measured, patch_m


def ruler_measures(length_m: float, width_m: float) -> HandFile:
    """Return what two measures by a ruler tell of a hand; the width is brought to what human hands have."""
    width_m = float(np.clip(width_m, *(length_m * np.array(WIDTH_OVER_LENGTH) * [1.02, 0.98])))
    return HandFile(
        date=today(),
        length_m=round(length_m, 4),
        width_m=round(width_m, 4),
        quality={"source": "two measures by a ruler"},
    )


def _with_object(rng: np.random.Generator, motion: HandMotion, flesh: Flesh) -> Flesh:
    """Return the hand with a round object in it, as thick as the closed fingers leave room for."""
    hand = motion.at(np.linspace(0.0, motion.seconds, 40))
    local = (hand.chain[:, :, 3] - hand.wrist[:, None]) @ hand.R
    thumb, fingers = np.median(local[:, 0], axis=0), np.median(local[:, 1:].mean(axis=1), axis=0)
    middle, axis = 0.5 * (thumb + fingers), np.array([1.0, 0.0, 0.0])
    apart = local - middle
    apart -= axis * (apart @ axis)[..., None]
    room = np.percentile(np.linalg.norm(apart, axis=-1), 10) - float(flesh.bones_m[:, 2].mean())
    radius = float(np.clip(room, 0.006, 0.040))
    return Flesh(flesh.bones_m, flesh.palm_m, middle, axis * float(rng.uniform(0.03, 0.06)), radius)


__all__ = ["MARKERS", "START_NS", "MarkerKind", "Tracks", "Truth", "make_tracks"]


@dataclass(frozen=True, slots=True)
class Tracks:
    """One rig before one clip.

    Attributes:
        seed: of everything.
        name: of the clip.
        rig: as fusion and ik are given it; its folder holds `cameras.json` with quality figures.
        draw: the rig as it was drawn, with the true cameras.
        frames: marker frames in the order in which they would arrive (by the end of their read-out).
        truth: what was true.
        grasps: whether an object is held.
    """

    seed: int
    name: str
    rig: Rig
    draw: RigDraw
    frames: list[MarkerFrame]
    truth: Truth
    grasps: bool


def make_tracks(
    seed: int,
    data: Path,
    folder: Path,
    *,
    seconds: float = 4.0,
    rate_hz: float | None = None,
    noise_px: float | None = None,
    markers: MarkerKind = "caps",
    family: Family | None = None,
) -> Tracks:
    """Draw a rig, a clip and a hand of the family, and return what its cameras see.

    The same seed gives the same clip, hand and rig whatever the rate, the noise and the kind of marker.

    Args:
        seed: even seeds are for developing, odd ones are held back.
        data: folder with the recorded hands.
        folder: of the rig, to be written.
        seconds: length of the clip, as far as the recording goes.
        rate_hz: of all cameras instead of the drawn one.
        noise_px: instead of the drawn one.
        markers: `caps` gives the middle of the paint that is seen, `bands` that of tapes around the fingers, `points`
            that of the whole marker, seen or hidden alike; all are hidden by flesh and object.
        family: bounds to draw from.
    """
    rng = np.random.default_rng([12, seed])
    streams = rng.spawn(3)
    draw = draw_rig(seed, family or Family(), rate_hz, noise_px)
    motion, hand_name, grasps = draw_clip(streams[0], data, seconds, draw)
    flesh, surfaces, hand_file, patch_m = draw_hand(streams[1], motion, grasps, _BARE_M if markers == "bands" else 0.0)
    rig = write_rig(draw, folder, hand_file, patch_m)
    gate_px = [rig.config.markers[name].min_area_px for name in MARKERS]
    parts = [
        camera_sights(rng_camera, number, name, draw, motion, surfaces, flesh, gate_px, markers)
        for number, (name, rng_camera) in enumerate(zip(draw.true, streams[2].spawn(len(draw.true)), strict=True))
    ]
    frames = sorted((frame for part in parts for frame in part.frames), key=lambda frame: frame.t_ns)
    truth = Truth(
        motion,
        surfaces,
        tuple(part.t_ns for part in parts),
        tuple(part.visible for part in parts),
        tuple(part.whole for part in parts),
    )
    return Tracks(seed, hand_name, rig, draw, frames, truth, grasps)
