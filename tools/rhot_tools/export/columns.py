"""Tables of recorded messages: one table a key, one row a moment, one column a number."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Mapping
from typing import Final

from rhot.anatomy.skeleton import FINGER_ANGLES, FINGERS, JOINTS, angle_name
from rhot.messages import BodyPose, FootPose, HandPose, MarkerFrame, Message, ObjectPose, PointSet

Value = float | int | str

_COVARIANCES: Final = ("xx", "xy", "xz", "yy", "yz", "zz")


class Table:
    """Columns of equal length, ordered by time; the last message of a moment counts.

    Attributes:
        name: of the table, such as `hand_right`.
        t_ns: (N,) capture times, nanoseconds since the Unix epoch, rig clock.
        columns: by name: numbers (NaN = no value) or words (empty = no value).
        whole: names of the columns of numbers that count something and so have no decimals.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.t_ns: array[int] = array("q")
        self.columns: dict[str, array[float] | list[str]] = {}
        self.whole: set[str] = set()

    def add(self, t_ns: int, row: Mapping[str, Value]) -> None:
        """Append one row; a column that is new has no value in the rows before."""
        length = len(self.t_ns)
        self.t_ns.append(t_ns)
        for name, value in row.items():
            if name not in self.columns:
                empty: array[float] | list[str] = (
                    [""] * length if isinstance(value, str) else array("d", [math.nan]) * length
                )
                self.columns[name] = empty
                if isinstance(value, int):
                    self.whole.add(name)
            self.columns[name].append(value)  # type: ignore[arg-type]  # a column keeps the type of its first value
        for column in self.columns.values():
            if len(column) == length:
                column.append("" if isinstance(column, list) else math.nan)  # type: ignore[arg-type]

    def order(self) -> list[int]:
        """Return the rows' numbers by time, for each moment the row that was added last."""
        last = {t_ns: row for row, t_ns in enumerate(self.t_ns)}
        return [last[t_ns] for t_ns in sorted(last)]


def tables(messages: Iterable[tuple[str, Message]]) -> list[Table]:
    """Return a table for every hand, point set, object, head, foot, body and camera in a recording."""
    found: dict[str, Table] = {}
    for key, message in messages:
        row = row_of(message)
        if row is None:
            continue
        name = key.removeprefix("rhot/").replace("/", "_")
        if name not in found:
            found[name] = Table(name)
        found[name].add(message.t_ns, row)
    return [found[name] for name in sorted(found)]


def row_of(message: Message) -> dict[str, Value] | None:
    """Return the columns of a message; None for kinds that are not exported."""
    row: dict[str, Value] | None = None
    match message:
        case HandPose():
            row = _hand(message)
        case PointSet():
            row = _points(message)
        case ObjectPose():
            row = {"state": message.state, **_pose("", message.position, message.orientation)}
        case FootPose():
            row = _foot(message)
        case BodyPose():
            row = _body(message)
        case MarkerFrame():
            row = _markers(message)
    return row


def _hand(hand: HandPose) -> dict[str, Value]:
    row: dict[str, Value] = {"state": hand.state}
    for name in JOINTS:
        joint = hand.joints.get(name)
        if joint is None:
            row |= _pose(f"{name}_", (math.nan,) * 3, (math.nan,) * 4)
        else:
            row |= _pose(f"{name}_", joint.position, joint.orientation)
        row[f"{name}_radius"] = math.nan if joint is None else joint.radius
        row[f"{name}_sigma"] = hand.sigma.get(name, math.nan)
    for finger in FINGERS:
        angles, sigmas = hand.angles.get(finger), hand.angle_sigma.get(finger)
        for angle in FINGER_ANGLES:
            row[angle_name(finger, angle)] = math.nan if angles is None else getattr(angles, angle)
            row[f"{angle_name(finger, angle)}_sigma"] = math.nan if sigmas is None else getattr(sigmas, angle)
        row[f"{finger}_residual"] = hand.residual.get(finger, math.nan)
        row[f"{finger}_state"] = hand.fingers.get(finger, "")
    return row


def _foot(foot: FootPose) -> dict[str, Value]:
    row: dict[str, Value] = {"state": foot.state, "stage": foot.stage, "stationary": int(foot.stationary)}
    row |= _pose("", foot.position, foot.orientation)
    return row | dict(zip(("vx", "vy", "vz"), foot.velocity, strict=True)) | {"sigma": foot.sigma}


def _body(body: BodyPose) -> dict[str, Value]:
    row: dict[str, Value] = {"state": body.state}
    for name, joint in body.joints.items():
        row |= _pose(f"{name}_", joint.position, joint.orientation)
    for side, angles in body.angles.items():
        row |= {f"{side}_{name}": value for name, value in angles}
    row |= {f"{side}_state": state for side, state in body.legs.items()}
    return row | {f"{side}_arm_state": state for side, state in body.arms.items()}


def _points(points: PointSet) -> dict[str, Value]:
    row: dict[str, Value] = {}
    for name, point in points.points.items():
        row |= dict(zip((f"{name}_x", f"{name}_y", f"{name}_z"), point.position, strict=True))
        row |= {f"{name}_sigma": point.sigma, f"{name}_views": point.views, f"{name}_state": point.state}
        covariance = (math.nan,) * len(_COVARIANCES) if point.covariance is None else point.covariance
        row |= {f"{name}_cov_{part}": value for part, value in zip(_COVARIANCES, covariance, strict=True)}
    return row


def _markers(frame: MarkerFrame) -> dict[str, Value]:
    row: dict[str, Value] = {"frame": frame.frame}
    for name, marker in frame.markers.items():
        row |= {
            f"{name}_u": marker.u,
            f"{name}_v": marker.v,
            f"{name}_area": marker.area,
            f"{name}_score": marker.score,
        }
        # Where the sensor scans by rows, a marker's own time differs from the frame's.
        offset_ns = 0 if marker.t_ns is None else marker.t_ns - frame.t_ns
        row[f"{name}_dt_s"] = offset_ns / 1e9
    return row


def _pose(prefix: str, position: Iterable[float], orientation: Iterable[float]) -> dict[str, Value]:
    names = (f"{prefix}{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw"))
    return dict(zip(names, (*position, *orientation), strict=True))
