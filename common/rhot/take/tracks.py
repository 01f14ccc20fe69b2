"""What was tracked, as arrays over time. All arrays are read-only; NaN stands where nothing is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion

Words = NDArray[np.str_]

MOST_GAP_S = 0.1
"""Between two samples that are interpolated; longer pauses stay gaps."""


_FINGER_PARTS = {
    finger: [f"{finger}_{part}" for part in ("proximal", "intermediate", "distal", "tip")] for finger in FINGERS[1:]
} | {"thumb": ["thumb_metacarpal", "thumb_proximal", "thumb_distal", "thumb_tip"]}
_MANO_FINGERS = ("index", "middle", "little", "ring", "thumb")
LANDMARKS = {
    "mediapipe": ("wrist", *(part for finger in FINGERS for part in _FINGER_PARTS[finger])),
    "mano": (
        "wrist",
        *(part for finger in _MANO_FINGERS for part in _FINGER_PARTS[finger][:3]),
        *(f"{finger}_tip" for finger in FINGERS),
    ),
}
"""Names of 21 points. `mediapipe`: wrist, then of each finger from the knuckle to the tip, four points, thumb first, as
dex-retargeting and most data sets of hands have them. `mano`: the 16 joints of the model MANO (Romero et al. 2017) in
its order, then the five tips as the package smplx appends them."""
_ROWS = {order: [JOINTS.index(name) for name in names] for order, names in LANDMARKS.items()}
_WRIST = JOINTS.index("wrist")
_TO_MANO_AXES: FloatArray = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Columns: MANO's x, y and z as it is turned for robot hands, in OpenXR's axes of the wrist; for both hands."""


def landmarks21(positions: FloatArray, orientations: FloatArray, order: str, frame: str | None) -> FloatArray:
    """Return 21 points (..., 21, 3), metres, of joints (..., 26, 3) with orientations (..., 26, 4); see `HandTrack`."""
    if order not in _ROWS:
        raise ValueError(f"order {order!r}: choose one of {', '.join(_ROWS)}")
    if frame not in (None, "wrist"):
        raise ValueError(f"frame {frame!r}: choose 'wrist', or none for the frame of the hand")
    points: FloatArray = positions[..., _ROWS[order], :]
    if frame == "wrist":
        axes = rotation_from_quaternion(orientations[..., _WRIST, :]) @ _TO_MANO_AXES
        points = (points - positions[..., _WRIST, None, :]) @ axes
    return points


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Track:
    """One thing over T moments.

    Attributes:
        name: as in its key, such as `hand/right`.
        t_ns: (T,) int64, increasing: when each sample was true, nanoseconds since 1970 on the rig clock.
        start_ns: of the take.
    """

    name: str
    t_ns: NDArray[np.int64]
    start_ns: int

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        # What comes from another process can be written.
        self.__post_init__()

    def __len__(self) -> int:
        return len(self.t_ns)

    def __repr__(self) -> str:
        seconds = 1e-9 * float(self.t_ns[-1] - self.t_ns[0]) if len(self) else 0.0
        state = getattr(self, "state", None)
        measured = "" if state is None or not len(self) else f", {100 * np.mean(state == 'measured'):.0f} % measured"
        return f"<{type(self).__name__} {self.name}: {len(self)} samples in {seconds:.1f} s{measured}>"

    @property
    def t(self) -> FloatArray:
        """(T,) seconds from the take's start."""
        return np.asarray(1e-9 * (self.t_ns - self.start_ns), dtype=np.float64)

    def resampled(self, t_ns: NDArray[np.int64]) -> Self:
        """Return the track at other moments (N,), int64, increasing.

        Numbers are interpolated linearly and quaternions on the sphere, between samples at most 0.1 s apart; elsewhere
        they are NaN. Words are those of the nearer sample.

        Raises:
            ValueError: these are no such moments; `Take.resampled` takes a rate.
        """
        if np.ndim(t_ns) != 1 or np.asarray(t_ns).dtype.kind != "i" or not (np.diff(t_ns) > 0).all():
            raise ValueError("t_ns must be nanoseconds (N,), whole numbers that increase; Take.resampled takes a rate")
        if not len(self):
            return self
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, max(len(self) - 1, 1))
        before = after - 1 if len(self) > 1 else after * 0
        after = np.minimum(after, len(self) - 1)
        span = np.maximum(self.t_ns[after] - self.t_ns[before], 1)
        share = np.clip((t_ns - self.t_ns[before]) / span, 0.0, 1.0)
        outside = (t_ns < self.t_ns[0]) | (t_ns > self.t_ns[-1]) | (1e-9 * span > MOST_GAP_S)
        # A sample itself counts, also at the edge of a gap.
        outside &= (t_ns != self.t_ns[before]) & (t_ns != self.t_ns[after])
        nearer = np.where(share < 0.5, before, after)
        changes: dict[str, Any] = {"t_ns": t_ns}
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name == "t_ns" or not isinstance(value, np.ndarray) or len(value) != len(self):
                continue
            if value.dtype.kind != "f":
                near = value[nearer]
                near[outside] = np.zeros((), value.dtype)
                changes[each.name] = near
                continue
            weight = share.reshape(-1, *(1,) * (value.ndim - 1))
            first, second = value[before], value[after]
            if each.name == "orientations":
                made = _slerp(first, second, weight)
            else:
                # At a sample itself the other one may be missing.
                made = np.where(
                    weight == 0.0, first, np.where(weight == 1.0, second, first + weight * (second - first))
                )
            made[outside] = np.nan
            changes[each.name] = made
        return replace(self, **changes)

    def moved(self, T_to_from: FloatArray) -> Self:
        """Return the track in another frame, T_to_from (4, 4), metres."""
        R = T_to_from[:3, :3]
        changes: dict[str, Any] = {}
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name == "positions":
                changes["positions"] = value @ R.T + T_to_from[:3, 3]
            elif each.name == "velocities":
                changes["velocities"] = value @ R.T
            elif each.name == "orientations":
                known = np.isfinite(value).all(axis=-1)
                turned = np.full_like(value, np.nan)
                turned[known] = quaternion_from_rotation(R @ rotation_from_quaternion(value[known]))
                changes["orientations"] = turned
            elif each.name == "covariances":
                changes["covariances"] = R @ value @ R.T
        return replace(self, **changes)


def _slerp(first: FloatArray, second: FloatArray, share: FloatArray) -> FloatArray:
    """Return quaternions (..., 4) between two, along the shorter arc (Shoemake 1985); normalised lines where close."""
    cosine = np.sum(first * second, axis=-1, keepdims=True)
    second = np.where(cosine < 0.0, -second, second)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    close = angle < 1e-4
    sine = np.where(close, 1.0, np.sin(angle))
    one = np.where(close, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    other = np.where(close, share, np.sin(share * angle) / sine)
    between: FloatArray = one * first + other * second
    return np.asarray(between / np.linalg.norm(between, axis=-1, keepdims=True))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class JointTrack(Track):
    """A skeleton over time: a hand, or the body.

    Attributes:
        joint_names: names of the J joints, OpenXR's.
        positions: (T, J, 3) metres.
        orientations: (T, J, 4) unit quaternions x, y, z, w of the joints' axes.
        sigma: (T, J) standard deviation of each position, metres (root of the sum of the three variances).
        angle_names: names of the A joint angles.
        angles: (T, A) radians.
        state: (T,) of each pose: `measured` or `predicted`.
    """

    joint_names: tuple[str, ...]
    positions: FloatArray
    orientations: FloatArray
    sigma: FloatArray
    angle_names: tuple[str, ...]
    angles: FloatArray
    state: Words

    def joint(self, name: str) -> FloatArray:
        """Return the positions (T, 3) of one joint, metres.

        Raises:
            KeyError: no such joint.
        """
        return self.positions[:, _index(self.joint_names, name, "joint")]

    def angle(self, name: str) -> FloatArray:
        """Return one joint angle (T,), radians.

        Raises:
            KeyError: no such angle.
        """
        return self.angles[:, _index(self.angle_names, name, "angle")]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class HandTrack(JointTrack):
    """A hand over time; `joint_names` are the 26 of OpenXR's XR_EXT_hand_tracking, `angle_names` four a finger.

    Attributes:
        radii: (T, 26) distance from each joint to the skin, metres.
        angle_sigma: (T, 20) standard deviation of each angle, radians.
        residuals: (T, 5) distance between each finger's measured and modelled marker, metres.
        finger_states: (T, 5) `measured` or `predicted`, thumb to little finger; empty = not said.
    """

    radii: FloatArray
    angle_sigma: FloatArray
    residuals: FloatArray
    finger_states: Words

    def landmarks21(self, order: str = "mediapipe", frame: str | None = None) -> FloatArray:
        """Return 21 points (T, 21, 3), metres.

        Args:
            order: `mediapipe` or `mano`, see `LANDMARKS`.
            frame: None = that of the take; `wrist` = origin in the wrist, x out of the palm, z along the fingers, y to
                the left of a hand whose palm faces down: what `dex_retargeting` takes for robot hands.

        Raises:
            ValueError: no such order or frame.
        """
        return landmarks21(self.positions, self.orientations, order, frame)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class PointTrack(Track):
    """A marker in space over time.

    Attributes:
        positions: (T, 3) metres.
        covariances: (T, 3, 3) square metres.
        sigma: (T,) root of the sum of the three variances, metres.
        views: (T,) cameras that see it; 0 where it is unknown.
        state: (T,) `measured`, `one_view`, `predicted`; empty where it is unknown.
    """

    positions: FloatArray
    covariances: FloatArray
    sigma: FloatArray
    views: NDArray[np.int64]
    state: Words


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class RigidTrack(Track):
    """An object, the head or a foot over time.

    Attributes:
        positions: (T, 3) metres.
        orientations: (T, 4) unit quaternions x, y, z, w.
        velocities: (T, 3) m/s; feet only.
        sigma: (T,) of the position, metres; feet only.
        state: (T,) `measured` or `predicted`.
        stage: (T,) of feet: `marker`, `depth`, `inertial` or `lost`.
        shape: of an object where it is known (`rhot.messages.ObjectShape`).
    """

    positions: FloatArray
    orientations: FloatArray
    velocities: FloatArray
    sigma: FloatArray
    state: Words
    stage: Words
    shape: Any = None


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class MarkerTracks(Track):
    """What one camera saw: M markers in T pictures.

    Attributes:
        marker_names: names of the markers.
        uv: (T, M, 2) pixels of the raw image; NaN = not seen.
        area: (T, M) square pixels.
        score: (T, M) 0 to 1.
    """

    marker_names: tuple[str, ...]
    uv: FloatArray
    area: FloatArray
    score: FloatArray


def _index(names: Sequence[str], name: str, what: str) -> int:
    try:
        return list(names).index(name)
    except ValueError:
        raise KeyError(f"no {what} {name!r}; there are {', '.join(names)}") from None
