"""Gathering views of the marker, from pictures and the head's poses as they come."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.aruco_dictionary import marker_dictionary
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rotation_between, vector_from_rotation
from rhot.messages import HeadPose
from rhot.rig.feet_config import FeetConfig
from rhot_calibration.headset.first_poses import HeadsetView
from rhot_feet.frames import ColorImage
from rhot_feet.head_track import HeadTrack
from rhot_feet.marker.detection import MarkerDetection, MarkerFinder

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
            self._take(*self._waiting.popleft())
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

    def _take(self, t_ns: int, found: MarkerDetection) -> None:
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
