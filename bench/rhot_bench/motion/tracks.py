"""What the cameras of one rig see of one clip, as marker frames that capture would publish, and the truth beside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot.messages import MarkerFrame
from rhot.rig import HandFile, Rig
from rhot.rig.calibration import WIDTH_OVER_LENGTH, today
from rhot.rotations import nearest_rotation, rotation_from_vector, rotation_z
from rhot.skeleton import FINGERS, JOINTS
from rhot_bench.motion.hand_motion import HandMotion, HandShape
from rhot_bench.motion.painted import Flesh, Surface, cap_surface, patch_surface, seen_samples
from rhot_bench.motion.recordings import FloatArray, RecordedHand, list_recordings, read_recording
from rhot_bench.motion.rigs import Family, RigDraw, draw_rig, write_rig

IntArray = NDArray[np.int64]
MarkerKind = Literal["caps", "points"]

MARKERS: Final = (*FINGERS, "base")
START_NS: Final = 1_000_000_000_000
_FLESH_MM: Final = ((9.5, 9.5, 8.8), (9.5, 8.5, 7.6), (9.5, 8.6, 7.8), (9.0, 8.0, 7.3), (8.0, 7.2, 6.6))
"""Radii of the moving bones of a hand of 185 mm, thumb first; the means of `rhot.hand_anatomy.RADII_MM` along each."""
_HAND_M: Final = 0.185
_LEAST_SHARE: Final = 0.08
"""Share of its facing paint below which a marker is no blob of its own colour; capture's size gate acts beside it."""
_CORNER_TIMES: Final = 2.0
"""Corners of the patch are found this much less surely than a centroid; measured on G1: 0.2 px beside 0.1."""


@dataclass(frozen=True, slots=True)
class Truth:
    """What was true.

    Attributes:
        motion: the hand at any time.
        surfaces: painted surface of each marker of `MARKERS`, in a frame at the very tip or in the wrist frame.
        frame_t_ns: per camera (F,) mid-exposure of the middle row of every frame, lost ones included.
        visible: per camera (F, 6) whether the marker was a blob in that frame, lost ones included.
        whole: per camera (F, 6) share of the paint facing the camera that nothing hides.
    """

    motion: HandMotion
    surfaces: Sequence[Surface]
    frame_t_ns: tuple[IntArray, ...]
    visible: tuple[NDArray[np.bool_], ...]
    whole: tuple[FloatArray, ...]

    def seconds(self, t_ns: IntArray) -> FloatArray:
        """Return times (N,) as seconds of the clip."""
        return (np.asarray(t_ns, dtype=np.int64) - START_NS) * 1e-9

    def hand(self, t_ns: IntArray) -> HandShape:
        """Return the hand at times (N,)."""
        return self.motion.at(self.seconds(t_ns))

    def joints(self, t_ns: IntArray) -> FloatArray:
        """Return the 26 joints (N, 26, 3) of OpenXR at times (N,), metres, rig frame."""
        return self.hand(t_ns).joints

    def markers(self, t_ns: IntArray) -> FloatArray:
        """Return the middles (N, 6, 3) of paint and patch at times (N,), metres, rig frame."""
        hand = self.hand(t_ns)
        frames = [marker_frames_of(hand, number) for number in range(len(MARKERS))]
        return np.stack([origin + R @ self.surfaces[k].centre for k, (origin, R) in enumerate(frames)], axis=1)

    def bone_axes(self, t_ns: IntArray) -> FloatArray:
        """Return unit directions (N, 6, 3): of each outermost bone, for the patch from the wrist to the fingers."""
        hand = self.hand(t_ns)
        return np.stack([-marker_frames_of(hand, number)[1][:, :, 2] for number in range(len(MARKERS))], axis=1)

    def views(self, t_ns: IntArray) -> IntArray:
        """Return how many cameras see each marker (N, 6) at times (N,): in the frame nearest in time, lost or not."""
        count = np.zeros((len(t_ns), len(MARKERS)), dtype=np.int64)
        for times, visible in zip(self.frame_t_ns, self.visible, strict=True):
            count += visible[_nearest(times, t_ns)]
        return count

    def hidden_s(self, t_ns: IntArray) -> FloatArray:
        """Return for how long each marker (N, 6) has been hidden from all cameras; NaN before it was first seen."""
        hidden = np.full((len(t_ns), len(MARKERS)), np.nan)
        for marker in range(len(MARKERS)):
            last = np.sort(
                np.concatenate([t[v[:, marker]] for t, v in zip(self.frame_t_ns, self.visible, strict=True)])
            )
            if not len(last):
                continue
            place = np.searchsorted(last, t_ns, side="right") - 1
            after = (t_ns - last[np.maximum(place, 0)]) * 1e-9
            hidden[:, marker] = np.where(place >= 0, after, np.nan)
        return hidden


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
        markers: `caps` gives the middle of the paint that is seen, `points` that of the whole marker, seen or hidden
            alike; both are hidden by flesh and object.
        family: bounds to draw from.
    """
    rng = np.random.default_rng([12, seed])
    streams = rng.spawn(3)
    draw = draw_rig(seed, family or Family(), rate_hz, noise_px)
    motion, hand_name, grasps = _draw_clip(streams[0], data, seconds, draw)
    flesh, surfaces, hand_file, patch_m = _draw_hand(streams[1], motion, grasps)
    rig = write_rig(draw, folder, hand_file, patch_m)
    gate_px = [rig.config.markers[name].min_area_px for name in MARKERS]
    parts = [
        _camera_frames(rng_camera, number, name, draw, motion, surfaces, flesh, gate_px, markers)
        for number, (name, rng_camera) in enumerate(zip(draw.true, streams[2].spawn(len(draw.true)), strict=True))
    ]
    frames = sorted((frame for part in parts for frame in part[0]), key=lambda frame: frame.t_ns)
    truth = Truth(motion, surfaces, *(tuple(part[k] for part in parts) for k in (1, 2, 3)))
    return Tracks(seed, hand_name, rig, draw, frames, truth, grasps)


def marker_frames_of(hand: HandShape, number: int) -> tuple[FloatArray, FloatArray]:
    """Return origins (N, 3) and axes (N, 3, 3) of a marker's own frame: at the very tip, or the wrist frame."""
    if number == len(FINGERS):
        return hand.wrist, hand.R
    tip = hand.chain[:, number, 3]
    Z = hand.chain[:, number, 2] - tip
    Z /= np.linalg.norm(Z, axis=1, keepdims=True)
    X = hand.R[:, :, 0] - Z * (hand.R[:, :, 0] * Z).sum(axis=1, keepdims=True)
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    return tip, np.stack([X, np.cross(Z, X), Z], axis=-1)


def _draw_clip(rng: np.random.Generator, data: Path, seconds: float, draw: RigDraw) -> tuple[HandMotion, str, bool]:
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


def _draw_hand(
    rng: np.random.Generator, motion: HandMotion, grasps: bool
) -> tuple[Flesh, list[Surface], HandFile, tuple[float, float]]:
    """Return flesh, paint and patch of a hand, and what two measures by a ruler tell of it."""
    scale = motion.length_m / _HAND_M * float(rng.uniform(0.92, 1.12))
    bones_m = np.minimum(1e-3 * scale * np.array(_FLESH_MM), 0.45 * motion.bones[:, 2:])
    bones_m[:, 2] = np.minimum(bones_m[:, 2], bones_m[:, 1])
    tips = bones_m[:, 2]
    motion.tip_radius_m = tips
    lengths = rng.uniform(0.012, 0.022, 5) * scale
    surfaces = [
        cap_surface(max(float(length), 1.2 * float(r)), float(r), float(r) * float(rng.uniform(1.0, 1.15)))
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
    width = float(np.clip(across + rng.normal(0.0, 0.0015), *(length * np.array(WIDTH_OVER_LENGTH) * [1.02, 0.98])))
    measured = HandFile(
        date=today(), length_m=round(length, 4), width_m=round(width, 4), quality={"source": "two measures by a ruler"}
    )
    return flesh, surfaces, measured, patch_m


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


def _camera_frames(
    rng: np.random.Generator,
    number: int,
    name: str,
    draw: RigDraw,
    motion: HandMotion,
    surfaces: Sequence[Surface],
    flesh: Flesh,
    gate_px: Sequence[float],
    kind: MarkerKind,
) -> tuple[list[MarkerFrame], IntArray, NDArray[np.bool_], FloatArray]:
    """Return one camera's frames, and per frame its time and which markers it could see."""
    camera = draw.true[name]
    period_s = 1.0 / draw.rate_hz
    half_s = 0.5 * (draw.exposure_s + draw.readout_s)
    first = np.arange(draw.phases[number] * period_s, motion.seconds - 2.0 * half_s, period_s)
    count = len(first)
    visible, whole = np.zeros((count, len(MARKERS)), dtype=bool), np.zeros((count, len(MARKERS)))
    lost = rng.random(count) < draw.lost
    seen: list[list[tuple[str, dict[str, object]]]] = [[] for _ in range(count)]
    for marker, label in enumerate(MARKERS):
        t_s = _row_times(camera, first, draw, motion, surfaces[marker], marker)
        hand = motion.at(t_s)
        origin, R = marker_frames_of(hand, marker)
        points = origin[:, None] + surfaces[marker].points @ np.swapaxes(R, 1, 2)
        normals = surfaces[marker].normals @ np.swapaxes(R, 1, 2)
        finger = marker if marker < len(FINGERS) else -1
        facing, shown = seen_samples(points, normals, camera.center, flesh.capsules(hand), finger)
        depth = camera.to_camera(points.reshape(-1, 3))[:, 2].reshape(count, -1)
        to_px = float(camera.K[0, 0] * camera.K[1, 1]) * surfaces[marker].areas / depth**2
        area, full = (shown * to_px).sum(axis=1), (facing * to_px).sum(axis=1)
        uv = camera.project(points.reshape(-1, 3)).reshape(count, -1, 2)
        uv_seen = ((shown * to_px)[..., None] * uv).sum(axis=1) / np.maximum(area, 1e-9)[:, None]
        if kind == "points":
            uv_seen = camera.project(origin + R @ surfaces[marker].centre)
        share = area / np.maximum(full, 1e-9)
        noise = rng.normal(0.0, draw.noise_px, (count, 2))
        corner_noise = rng.normal(0.0, _CORNER_TIMES * draw.noise_px, (count, 4, 2))
        uv_seen = uv_seen + noise
        inside = camera.contains(np.nan_to_num(uv_seen, nan=-1e6))
        visible[:, marker] = inside & (area > gate_px[marker]) & (share > _LEAST_SHARE)
        whole[:, marker] = share
        corners = None
        if marker == len(FINGERS):
            corners = camera.project(_patch_corners(surfaces[marker], origin, R).reshape(-1, 3)).reshape(count, 4, 2)
            corners += corner_noise
        for frame in np.flatnonzero(visible[:, marker] & ~lost):
            u, v = uv_seen[frame].tolist()
            row_ns = START_NS + round(1e9 * float(t_s[frame]))
            found: dict[str, object] = {"u": u, "v": v, "area": float(area[frame]), "score": 0.5 + 0.5 * share[frame]}
            found["t_ns"] = row_ns if draw.readout_s > 0.0 else None
            if corners is not None and share[frame] > 0.97 and camera.contains(corners[frame]).all():
                found["corners"] = tuple(map(tuple, _clockwise(corners[frame]).tolist()))
            seen[frame].append((label, found))
    t_ns = START_NS + np.round(1e9 * (first + half_s)).astype(np.int64)
    frames = [
        MarkerFrame.model_validate(
            {
                "t_ns": int(t_ns[frame]),
                "seq": frame,
                "camera": name,
                "width": camera.width,
                "height": camera.height,
                "markers": dict(seen[frame]),
                "frame": frame,
            }
        )
        for frame in np.flatnonzero(~lost).tolist()
    ]
    return frames, t_ns, visible, whole


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


def _nearest(times: IntArray, wanted: IntArray) -> IntArray:
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    nearer = wanted - times[after - 1] < times[np.minimum(after, len(times) - 1)] - wanted
    return np.where(nearer, after - 1, np.minimum(after, len(times) - 1))
