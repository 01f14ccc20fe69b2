"""Views from a running rig, and from a recording of one."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.aruco_dictionary import marker_dictionary
from rhot.bus import CONNECT_S, Bus
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import (
    cross_matrix,
    nearest_rotation,
    rigid,
    rotation_between,
    rotation_from_vector,
    vector_from_rotation,
)
from rhot.messages import HeadPose
from rhot.recording import load_recording
from rhot.recording.camera_picture import PICTURES_KEY, CameraPicture
from rhot.recording.picture_file import decode_picture
from rhot.rig import BusConfig
from rhot.rig.feet_config import FeetConfig
from rhot_calibration.live import HINT_S, listening
from rhot_feet.frames import ColorImage, pinhole
from rhot_feet.head_track import HeadTrack
from rhot_feet.input_stream import CAMERA
from rhot_feet.marker.detection import MarkerDetection, MarkerFinder
from rhot_feet.offline import HEAD_KEY, recorded_heads
from rhot_feet.sources.depth_camera.recorded_frames import load_depth_recording

# Gathering views of the marker, from pictures and the head's poses as they come.

WANTED: Final = 250
"""Views; with 0.1 degrees of noise of the head's poses a foot is off by 0.8 mm at most (`rhot evaluate headset`)."""
LEAST_SPREAD_RAD: Final = float(np.radians(7.0))
"""Half the range through which the head should nod, turn and tilt; with less the position is known to a centimetre."""
MOTIONS: Final = ("nod", "turn", "tilt")
"""About level axes: to the right, up, and backwards from where the person looks."""
_MARGIN_PX: Final = 3.0
_MOVED_RAD, _MOVED_M = float(np.radians(0.7)), 0.008
"""A view from where the last one was taken says nothing new."""
_AROUND_NS: Final = 10_000_000
_MOST_WAITING: Final = 60
_HIDDEN_NS: Final = 2_000_000_000
"""A marker that is out of sight for a shorter time is not worth a word: the head moves."""


class ViewCollector:
    """Takes views until there are enough.

    Attributes:
        views: taken so far.
        camera: the lens; None before the first picture.
    """

    def __init__(self, feet: FeetConfig, marker_id: int | None = None, wanted: int = WANTED) -> None:
        """Prepare.

        Args:
            feet: `[feet]` of the rig.
            marker_id: the marker on the floor; the first foot's when not given.
            wanted: how many views.

        Raises:
            ConfigError: the dictionary has no such marker.
        """
        dictionary = marker_dictionary(feet.dictionary)
        self.marker_id = next(iter(feet.feet.values())).marker_id if marker_id is None else marker_id
        if not 0 <= self.marker_id < len(dictionary.bytesList):
            raise ConfigError(
                f'marker {self.marker_id}: dictionary "{feet.dictionary}" has the markers 0 to '
                f"{len(dictionary.bytesList) - 1}"
            )
        self.views: list[HeadsetView] = []
        self.camera: CameraModel | None = None
        self.wanted = wanted
        self._up = np.array(feet.up) / np.linalg.norm(feet.up)
        self._finder = MarkerFinder(dictionary, [self.marker_id])
        self._heads = HeadTrack()
        self._head_ns = 0
        self._waiting: deque[tuple[int, MarkerDetection]] = deque(maxlen=_MOST_WAITING)
        self._picture_ns = self._seen_ns = 0

    @property
    def done(self) -> bool:
        """Whether there are enough views, of enough motion."""
        return len(self.views) >= self.wanted and not self.lacking

    @property
    def share(self) -> float:
        """How much is done, 0 to 1."""
        motion = float(np.mean(np.minimum(1.0, self.spread_rad / LEAST_SPREAD_RAD)))
        return min(1.0, len(self.views) / self.wanted) * (0.5 + 0.5 * motion)

    @property
    def spread_rad(self) -> FloatArray:
        """(3,) half the range of the head's rotations as of `MOTIONS`, without the outermost tenths."""
        if len(self.views) < 2:
            return np.zeros(3)
        R = np.stack([view.T_rig_head[:3, :3] for view in self.views])
        middle = R[len(R) // 2]
        right = middle[:, 0] - (middle[:, 0] @ self._up) * self._up
        right /= max(float(np.linalg.norm(right)), 1e-9)
        level = np.stack([right, self._up, np.cross(right, self._up)], axis=1)
        turned = np.stack([vector_from_rotation(each @ middle.T) for each in R]) @ level
        low, high = np.percentile(turned, (5.0, 95.0), axis=0)
        half: FloatArray = 0.5 * (high - low)
        return half

    @property
    def lacking(self) -> list[str]:
        """Motions of which there was too little."""
        return [name for name, spread in zip(MOTIONS, self.spread_rad, strict=True) if spread < LEAST_SPREAD_RAD]

    @property
    def hint(self) -> str:
        """What the person should do next."""
        if self._picture_ns - self._seen_ns > _HIDDEN_NS:
            return f"marker {self.marker_id} is not in sight of the camera, or upside down under something"
        if self.lacking and len(self.views) >= 20:
            return f"{' and '.join(self.lacking)} your head more"
        return "go on: nod, turn and tilt your head, lean to all sides and bend your knees"

    def find(self, color: ColorImage) -> MarkerDetection | None:
        """Return the marker in a picture; takes milliseconds, and may be called on another thread."""
        found = self._finder.find(color)
        return found[0] if found else None

    def add_head(self, pose: HeadPose) -> bool:
        """Add a pose of the head; return whether views were taken."""
        self._heads.add(pose)
        if pose.state == "measured":
            self._head_ns = max(self._head_ns, pose.t_ns)
        before = len(self.views)
        while self._waiting and self._waiting[0][0] + _AROUND_NS <= self._head_ns:
            self._add_detection(*self._waiting.popleft())
        return len(self.views) > before

    def add_picture(self, t_ns: int, found: MarkerDetection | None, camera: CameraModel) -> None:
        """Add what `find` found in a picture, later than those before; its view is taken when the head's pose is there.

        Args:
            t_ns: middle of its exposure, rig clock.
            found: the marker.
            camera: the lens.
        """
        if self.camera is None:
            self.camera = camera
        self._picture_ns = t_ns
        if found is None:
            self._seen_ns = self._seen_ns or t_ns
            return
        self._seen_ns = t_ns
        highest = np.array([camera.width, camera.height]) - 1.0 - _MARGIN_PX
        if (found.corners > _MARGIN_PX).all() and (found.corners < highest).all():
            self._waiting.append((t_ns, found))

    def _add_detection(self, t_ns: int, found: MarkerDetection) -> None:
        before, T, after = (self._heads.at(t_ns + shift) for shift in (-_AROUND_NS, 0, _AROUND_NS))
        if before is None or T is None or after is None or len(self.views) >= 4 * self.wanted:
            return
        per_s = 1e9 / (2 * _AROUND_NS)
        velocity = per_s * np.concatenate(
            [vector_from_rotation(after[:3, :3] @ before[:3, :3].T), after[:3, 3] - before[:3, 3]]
        )
        # A faster head blurs the picture, and its time matters more.
        if float(np.linalg.norm(velocity[:3])) > float(np.radians(90.0)):
            return
        if self.views:
            last = self.views[-1].T_rig_head
            turned = float(np.linalg.norm(rotation_between(last[:3, :3], T[:3, :3])))
            if turned < _MOVED_RAD and float(np.linalg.norm(last[:3, 3] - T[:3, 3])) < _MOVED_M:
                return
        self.views.append(HeadsetView(t_ns, T, velocity, found.corners, found.corner_sigma_px))


# Views of a marker from a moving head, and a first idea of where camera and marker are.
#
# It comes from the marker's middle alone, whose position one picture tells well: 24 rotations of the camera are
# tried, each refined, and the best one goes on. Of the two poses that each picture of a square allows those are taken
# that agree on how the marker lies.

_STEPS: Final = 12


@dataclass(frozen=True, slots=True)
class HeadsetView:
    """One picture of the marker.

    Attributes:
        t_ns: middle of the exposure, rig clock.
        T_rig_head: (4, 4) at that time, metres.
        velocity: (6,) of the head there: rotation vector (rad/s), then position (m/s), rig axes.
        corners: (4, 2) pixels, as OpenCV's detector orders them.
        corner_sigma_px: their standard deviation per axis.
    """

    t_ns: int
    T_rig_head: FloatArray
    velocity: FloatArray
    corners: FloatArray
    corner_sigma_px: float


def first_poses(
    views: Sequence[HeadsetView], camera: CameraModel, square: FloatArray, guess: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return T_head_camera and T_rig_marker (4, 4) to begin with.

    Args:
        views: of the marker.
        camera: the lens.
        square: (4, 3) corners of the marker in its own frame, metres.
        guess: (4, 4) T_head_camera to try first.

    Raises:
        CalibrationError: the corners of a view are no square.
    """
    seen = [_solutions(view, camera, square) for view in views]
    middles = np.stack([solutions[0][:3, 3] for solutions in seen])
    R = np.stack([view.T_rig_head[:3, :3] for view in views])
    t = np.stack([view.T_rig_head[:3, 3] for view in views])
    starts = _cube_rotations() if guess is None else [guess[:3, :3], *_cube_rotations()]
    found = [_middles_fitted(start, middles, R, t) for start in starts]
    _, T_head_camera = min(found, key=lambda each: each[0])
    # Of both poses of each square those belong together that agree on how the marker lies in the rig.
    poses = np.stack(
        [[T @ T_head_camera @ pose for pose in each] for T, each in zip(_rigid_all(R, t), seen, strict=True)]
    )
    flat = poses.reshape(-1, 4, 4)
    cosines = np.einsum("aij,nsij->ans", flat[:, :3, :3], poses[:, :, :3, :3])
    best = int(np.argmax(np.median(cosines.max(axis=2), axis=1)))
    return T_head_camera, rigid(flat[best, :3, :3], np.median(flat[:, :3, 3], axis=0))


def _middles_fitted(start: FloatArray, middles: FloatArray, R: FloatArray, t: FloatArray) -> tuple[float, FloatArray]:
    """Return cost and T_head_camera for which all middles (N, 3), camera frame, are one point of the rig.

    R_i · (R_X · m_i + t_X) + t_i = p is linear in t_X and p; the rotation R_X is improved step by step.
    """
    count, R_X = len(middles), start.copy()
    linear = np.concatenate([R.reshape(-1, 3), np.tile(-np.eye(3), (count, 1))], axis=1)
    solution = np.zeros(6)
    residual = np.zeros(3 * count)
    for _ in range(_STEPS):
        turned = middles @ R_X.T
        here = np.einsum("nij,nj->ni", R, turned) + t
        lever = cross_matrix(-turned)
        A = np.concatenate([(R @ lever).reshape(-1, 3), linear], axis=1)
        solution_all = np.linalg.lstsq(A, -here.ravel(), rcond=1e-8)[0]
        turn, solution = solution_all[:3], solution_all[3:]
        longest_step_rad = 0.7
        R_X = nearest_rotation(
            rotation_from_vector(turn * min(1.0, longest_step_rad / max(float(np.linalg.norm(turn)), 1e-9))) @ R_X
        )
        residual = np.einsum("nij,nj->ni", R, middles @ R_X.T).ravel() + t.ravel() + linear @ solution
    # Robust: one wrong view must not decide which rotation is best.
    cost = float(np.median(np.linalg.norm(residual.reshape(-1, 3), axis=1)))
    return cost, rigid(R_X, solution[:3])


def _solutions(view: HeadsetView, camera: CameraModel, square: FloatArray) -> list[FloatArray]:
    """Return the two poses (4, 4) T_camera_marker of a square that a view allows, the likelier one first."""
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        square, view.corners, camera.K, camera.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not count:
        raise CalibrationError("a view of the marker has no pose: its corners are no square")
    poses = [
        rigid(rotation_from_vector(np.ravel(turn)), np.ravel(shift)) for turn, shift in zip(turns, shifts, strict=True)
    ]
    return poses if len(poses) == 2 else poses * 2


def _cube_rotations() -> list[FloatArray]:
    """Return the 24 rotations of a cube (3, 3)."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[range(3), order] = signs
            if np.linalg.det(R) > 0.0:
                found.append(R)
    return found


def _rigid_all(R: FloatArray, t: FloatArray) -> list[FloatArray]:
    return [rigid(one, shift) for one, shift in zip(R, t, strict=True)]


_HEAD_AHEAD_NS: Final = 100_000_000
_PICTURES: Final = f"{PICTURES_KEY}/{CAMERA}"


async def collect_views(
    config: BusConfig,
    collector: ViewCollector,
    *,
    patience_s: float,
    taken: Callable[[], None],
    hint: Callable[[str], None],
) -> None:
    """Fill a collector from a running rig until it is done.

    Args:
        config: how to reach the rig.
        collector: filled as it goes, so that an interrupted session keeps what there is.
        patience_s: how long pictures and head may stay silent.
        taken: called after new views.
        hint: called with what the person should do, whenever that changes.

    Raises:
        BusError: no router, or no picture or no pose of the head comes.
    """
    silent = {"pictures": "the feet's camera sends no pictures", "head": f"nobody publishes a measured {HEAD_KEY}"}
    heard_s = dict.fromkeys(silent, time.monotonic())
    done = asyncio.Event()

    async def follow_head(bus: Bus) -> None:
        async for _, pose in bus.events(HEAD_KEY).messages(HeadPose):
            if pose.state == "measured":
                heard_s["head"] = time.monotonic()
            if collector.add_head(pose):
                taken()
                if collector.done:
                    done.set()

    async def follow_pictures(bus: Bus) -> None:
        async for _, picture in bus.latest(_PICTURES).messages(CameraPicture):
            camera = _lens(picture)
            if camera is None:
                continue
            found = await asyncio.to_thread(_found, collector, picture.jpeg)
            heard_s["pictures"] = time.monotonic()
            collector.add_picture(picture.t_ns, found, camera)

    async def watch() -> None:
        said = ""
        while True:
            await asyncio.sleep(HINT_S)
            late = [what for what, at_s in heard_s.items() if time.monotonic() - at_s > patience_s]
            if late:
                raise BusError(
                    f"{' and '.join(silent[what] for what in late)}: are `rhot feet` and `rhot objects` running, and "
                    "the rig started (`rhot status`, `rhot start`)?"
                )
            if collector.hint != said:
                said = collector.hint
                hint(said)

    async with (
        await Bus.open(config, timeout_s=CONNECT_S) as bus,
        listening(follow_head(bus), follow_pictures(bus), watch(), _waited(done)) as tasks,
    ):
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in ended:
            task.result()


async def _waited(done: asyncio.Event) -> None:
    await done.wait()


def views_recorded(path: Path, collector: ViewCollector) -> None:
    """Fill a collector from a recording of `rhot record --frames`.

    Args:
        path: its folder.
        collector: to fill, with all that is there.

    Raises:
        ConfigError: the recording holds no depth camera or no poses of the head, or a file cannot be read.
    """
    recording = load_recording(path)
    if recording.depth_camera is None:
        raise ConfigError(f"{path}: holds no pictures of the feet's camera; `rhot record --frames` takes them")
    frames = load_depth_recording(recording.depth_camera, complete=recording.complete)
    heads = recorded_heads(recording.depth_camera)
    next_head = 0
    for frame in frames.frames():
        collector.add_picture(frame.t_ns, collector.find(frame.color), frame.camera)
        while next_head < len(heads) and heads[next_head].t_ns <= frame.t_ns + _HEAD_AHEAD_NS:
            collector.add_head(heads[next_head])
            next_head += 1


def _lens(picture: CameraPicture) -> CameraModel | None:
    lens = picture.lens
    if lens is None:
        return None
    return pinhole(lens.width, lens.height, np.array(lens.K), np.array(lens.distortion))


def _found(collector: ViewCollector, jpeg: bytes) -> MarkerDetection | None:
    image = decode_picture(jpeg)
    # What is no picture shows no marker.
    return None if image is None else collector.find(np.asarray(image, np.uint8))
