"""Tracks for pandas and xarray, which are loaded when somebody asks for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.take.tracks import HandTrack, JointTrack, PointTrack, RigidTrack, Track, Words

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from rhot.take.take import Take

_POSE: Final = ("x", "y", "z", "qx", "qy", "qz", "qw")
_COVARIANCES: Final = (("xx", 0, 0), ("xy", 0, 1), ("xz", 0, 2), ("yy", 1, 1), ("yz", 1, 2), ("zz", 2, 2))
_CONFIDENCE: Final = {"measured": 1.0, "one_view": 0.5, "predicted": 0.0}


def dataframe(track: Track) -> pd.DataFrame:
    """Return a track as a table; see `Take.to_dataframe`."""
    import pandas as pd  # noqa: PLC0415

    columns: dict[str, Any] = {"t_ns": track.t_ns}
    match track:
        case JointTrack():
            columns["state"] = track.state
            for index, joint in enumerate(track.joint_names):
                pose = np.concatenate([track.positions[:, index], track.orientations[:, index]], axis=1)
                columns |= {f"{joint}_{part}": pose[:, column] for column, part in enumerate(_POSE)}
                columns[f"{joint}_sigma"] = track.sigma[:, index]
                if isinstance(track, HandTrack):
                    columns[f"{joint}_radius"] = track.radii[:, index]
            columns |= {name: track.angles[:, index] for index, name in enumerate(track.angle_names)}
            if isinstance(track, HandTrack):
                columns |= {
                    f"{name}_sigma": track.angle_sigma[:, index] for index, name in enumerate(track.angle_names)
                }
                columns |= {f"{name}_residual": track.residuals[:, index] for index, name in enumerate(FINGERS)}
                columns |= {f"{name}_state": track.finger_states[:, index] for index, name in enumerate(FINGERS)}
        case PointTrack():
            columns |= {part: track.positions[:, index] for index, part in enumerate("xyz")}
            columns |= {"sigma": track.sigma, "views": track.views, "state": track.state}
            columns |= {f"cov_{name}": track.covariances[:, row, column] for name, row, column in _COVARIANCES}
        case RigidTrack():
            columns |= {"state": track.state}
            pose = np.concatenate([track.positions, track.orientations], axis=1)
            columns |= {part: pose[:, index] for index, part in enumerate(_POSE)}
            if np.isfinite(track.velocities).any():
                columns |= {name: track.velocities[:, index] for index, name in enumerate(("vx", "vy", "vz"))}
                columns |= {"sigma": track.sigma, "stage": track.stage}
        case _:
            raise KeyError(f"{track.name} has no table")
    return pd.DataFrame(columns, index=pd.Index(track.t, name="t"))


def dataset(take: Take, what: str) -> xr.Dataset:
    """Return tracks in movement's layout; see `Take.to_xarray`."""
    import xarray as xr  # noqa: PLC0415

    individuals, keypoints = _chosen(take, what)
    if not individuals:
        raise KeyError(f"the take holds no {what!r}; choose hands, points, objects, feet or body, what of these it has")
    tracks = [track for parts in individuals.values() for track in parts.values()]
    t_ns = np.unique(np.concatenate([track.t_ns for track in tracks]))
    shape = (len(t_ns), len(keypoints), len(individuals))
    position = np.full((shape[0], 3, *shape[1:]), np.nan)
    sigma, sure = np.full(shape, np.nan), np.full(shape, np.nan)
    for number, parts in enumerate(individuals.values()):
        for first, track in parts.items():
            rows = np.searchsorted(t_ns, track.t_ns)
            places, errors, states = _keypoints(track)
            keys = slice(first, first + places.shape[1])
            position[rows, :, keys, number] = places.transpose(0, 2, 1)
            sigma[rows, keys, number] = errors
            sure[rows, keys, number] = states
    dims = ("time", "keypoints", "individuals")
    seconds = 1e-9 * (t_ns - take.start_ns)
    steps = np.diff(seconds)
    return xr.Dataset(
        {
            "position": (("time", "space", "keypoints", "individuals"), position),
            "confidence": (dims, sure),
            "sigma": (dims, sigma),
        },
        coords={
            "time": seconds,
            "space": ["x", "y", "z"],
            "keypoints": list(keypoints),
            "individuals": list(individuals),
            "t_ns": ("time", t_ns),
        },
        attrs={
            "source_software": "rhot",
            "ds_type": "poses",
            "time_unit": "seconds",
            "fps": float(1.0 / np.median(steps)) if len(steps) else np.nan,
            "space_unit": "metres",
            "frame": take.frame,
        },
    )


def _chosen(take: Take, what: str) -> tuple[dict[str, dict[int, Any]], Sequence[str]]:
    """Return individuals, each with its tracks by the number of their first keypoint, and the keypoints' names."""
    if what == "hands":
        hands = {side: {0: hand} for side, hand in sorted(take.hands.items())}
        return hands, next(iter(take.hands.values())).joint_names if hands else ()
    if what == "body" and take.body is not None:
        return {"body": {0: take.body}}, take.body.joint_names
    kinds: Mapping[str, Mapping[str, Track]] = {"points": take.points, "objects": take.objects, "feet": take.feet}
    if kinds.get(what):
        names = sorted(kinds[what])
        if what == "points":
            return {"points": {index: take.points[name] for index, name in enumerate(names)}}, names
        return {name: {0: kinds[what][name]} for name in names}, ["origin"]
    return {}, ()


def _keypoints(track: Any) -> tuple[FloatArray, NDArray[Any], NDArray[Any]]:
    """Return positions (T, K, 3), sigma and confidence (T, K)."""
    sure = confidence(track.state)[:, None]
    if isinstance(track, JointTrack):
        return track.positions, track.sigma, np.broadcast_to(sure, track.sigma.shape)
    return track.positions[:, None], track.sigma[:, None], sure


def confidence(states: Words) -> FloatArray:
    """Return states (T,) as numbers: 1 measured, 0.5 seen by one camera, 0 predicted, NaN unknown."""
    return np.array([_CONFIDENCE.get(str(state), np.nan) for state in states])
