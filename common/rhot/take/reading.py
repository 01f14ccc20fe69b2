"""`rhot.load`: a recording as arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import BODY_PARENTS, FINGERS, HAND_ANGLES, JOINTS, angle_name
from rhot.arrays import FloatArray
from rhot.errors import ConfigError, WireError
from rhot.messages import (
    BodyPose,
    Event,
    FootPose,
    HandPose,
    LegAngles,
    MarkerFrame,
    Message,
    ObjectPose,
    PointSet,
    Space,
    decode,
    encode,
    unpack,
)
from rhot.recording.attached import file_beside, rig_of
from rhot.recording.mcap.writer import RIG_PREFIX
from rhot.recording.messages import RecordedMessages
from rhot.rig import Rig
from rhot.rig.folder import STAGE_FILE
from rhot.take.payloads import Path as Place
from rhot.take.payloads import PayloadColumns, table_of, whole_numbers, words
from rhot.take.take import Take
from rhot.take.tracks import HandTrack, JointTrack, MarkerTracks, PointTrack, RigidTrack

_BODY_ANGLES: Final = tuple((side, angle) for side in ("left", "right") for angle in LegAngles.model_fields)
_FULL: Final = (0, 1, 2, 1, 3, 4, 2, 4, 5)
"""A covariance's nine numbers among xx, xy, xz, yy, yz, zz."""
_STAGE: Final = "rhot/space/stage"
_SUFFIXES: Final = (".mcap", ".jsonl")
_KEPT: Final = (HandPose, PointSet, ObjectPose, FootPose, BodyPose, Space)
_TRACKED: Final = {"hand", "points", "object", "head", "foot", "body"}
_RIGID: Final = (("position", 3), ("orientation", 4), ("velocity", 3))


def load(path: str | Path, *more: str | Path) -> Take:
    """Return everything that a recording holds, as arrays.

    Args:
        path: an MCAP file of `rhot record`, JSON Lines of `rhot process`, or a folder of pictures with such a file in
            it or, of the same name, beside it.
        more: further parts of the same recording (`rhot record --max-mb`).

    Raises:
        ConfigError: the file is missing or no recording, or the folder was not tracked yet.
    """
    sources = [RecordedMessages(_file_of(Path(each))) for each in (path, *more)]
    columns: dict[str, PayloadColumns] = {}
    cameras: dict[str, None] = {}
    events: list[Event] = []
    invalid = 0
    for source in sources:
        for key, model, payloads in source.payloads(leave_out=MarkerFrame):
            if model is MarkerFrame:
                cameras[key] = None
            elif model is Event:
                for payload in payloads:
                    try:
                        events.append(decode(payload, Event))
                    except WireError:
                        invalid += 1
            elif issubclass(model, _KEPT):
                columns.setdefault(key, PayloadColumns(model)).add(*payloads)
        invalid += source.invalid

    note = "; ".join(source.note for source in sources if source.note)
    # A frame that no message names may stand in the rig folder.
    asks_rig = _STAGE not in columns and any(f"{RIG_PREFIX}{STAGE_FILE}" in source.attachments for source in sources)
    frames = rig_of(sources) if asks_rig else None
    return _made(
        columns,
        events,
        partial(_marker_tracks, partial(_rows_in, sources, tuple(cameras))),
        partial(rig_of, sources),
        frames=frames,
        invalid=invalid,
        note=note,
    )


def take_of(messages: Iterable[tuple[str, Message]], rig: Rig | None = None) -> Take:
    """Return messages of a rig as a take, such as `rhot.offline.track` yields them.

    Args:
        messages: key and message, each key's in order.
        rig: that they come from.
    """
    columns: dict[str, PayloadColumns] = {}
    events: list[Event] = []
    seen: list[MarkerRow] = []
    for key, message in messages:
        if isinstance(message, MarkerFrame):
            seen.append(
                (
                    message.camera,
                    message.t_ns,
                    {name: (m.u, m.v, m.area, m.score) for name, m in message.markers.items()},
                )
            )
        elif isinstance(message, Event):
            events.append(message)
        elif isinstance(message, _KEPT):
            columns.setdefault(key, PayloadColumns(type(message))).add(encode(message))
    return _made(columns, events, partial(_marker_tracks, partial(list, seen)), partial(_given, rig), frames=rig)


def _file_of(path: Path) -> Path:
    if not path.is_dir():
        return path
    inside = [file for suffix in _SUFFIXES for file in sorted(path.glob(f"*{suffix}"))]
    beside = [file for suffix in _SUFFIXES if (file := file_beside(path, suffix)).is_file()]
    found = inside or beside
    if len(found) != 1:
        what = "several tracked files: " + ", ".join(file.name for file in found) if found else "no tracked file"
        raise ConfigError(
            f"{path}: {what}; name the file, or track the folder: rhot process {path} --rig RIG --out "
            f"{file_beside(path, '.mcap')}"
        )
    return found[0]


# From columns to tracks.


class _Rows:
    """The messages of one key in the order of time, the last of each moment."""

    def __init__(self, columns: PayloadColumns) -> None:
        self._groups = columns.groups()
        self._count = columns.count
        t_ns = whole_numbers(self._groups, ("t_ns",), self._count)
        order = np.argsort(t_ns, kind="stable")
        order = order[t_ns[order] >= 0]
        last = np.append(t_ns[order][1:] != t_ns[order][:-1], True)[: len(order)]
        order = order[last]
        self.t_ns = t_ns[order]
        in_order = len(order) == self._count and bool((order == np.arange(self._count)).all())
        self._order: NDArray[np.int64] | slice = slice(None) if in_order else order

    def __len__(self) -> int:
        return len(self.t_ns)

    def table(self, places: Sequence[Place]) -> FloatArray:
        """Return numbers at places (T, C)."""
        table = table_of(self._groups, {place: index for index, place in enumerate(places)}, self._count)
        return np.asarray(table[self._order])

    def words(self, word: Callable[[Any], str]) -> NDArray[np.str_]:
        """Return a word of each message (T,)."""
        return np.asarray(words(self._groups, word, self._count)[self._order])

    def names(self, found: Callable[[Any], Iterable[str]]) -> list[str]:
        """Return all names that occur in the messages, in the order of their first appearance."""
        return list(dict.fromkeys(name for group in self._groups for name in found(group.first)))

    @property
    def first(self) -> Any:
        """One message."""
        return self._groups[0].first


def _made(
    columns: dict[str, PayloadColumns],
    events: list[Event],
    markers: Callable[[int], Mapping[str, MarkerTracks]],
    rig: Callable[[], Rig | None],
    *,
    frames: Rig | None = None,
    invalid: int = 0,
    note: str = "",
) -> Take:
    """Return the take; `frames`: the rig that knows frames which no message names. Empties the columns."""
    rows = {}
    while columns:
        # Ten minutes of a hand are 160 MB: nothing is kept twice.
        key, read = columns.popitem()
        rows[key] = _Rows(read)
        invalid += read.invalid
    rows = {key: rows[key] for key in sorted(rows) if len(rows[key])}
    start_ns = min((int(each.t_ns[0]) for key, each in rows.items() if _kind(key) in _TRACKED), default=0)
    found: dict[str, dict[str, Any]] = {kind: {} for kind in ("hand", "object", "foot", "points", "body", "head")}
    spaces = {} if frames is None else _spaces_of(frames)
    for key in list(rows):
        each = rows.pop(key)
        kind, name = _kind(key), key.rpartition("/")[2]
        if kind == "points":
            found[kind] = _points(each, start_ns)
        elif kind in found:
            make = {"hand": _hand, "body": _body}.get(kind, _rigid)
            found[kind][name] = make(key.removeprefix("rhot/"), each, start_ns)
        elif kind == "space":
            T = each.table([("T_rig_space", row, column) for row in range(4) for column in range(4)])
            spaces[name] = T[-1].reshape(4, 4)
    return Take(
        hands=found["hand"],
        points=found["points"],
        objects=found["object"],
        feet=found["foot"],
        body=found["body"].get("body"),
        head=found["head"].get("head"),
        events=tuple(sorted(events, key=lambda event: event.t_ns)),
        spaces=spaces,
        start_ns=start_ns,
        invalid=invalid,
        note=note,
        _markers=partial(markers, start_ns),
        _rig=rig,
    )


def _kind(key: str) -> str:
    return key.split("/")[1]


def _spaces_of(rig: Rig) -> dict[str, FloatArray]:
    return {} if rig.stage is None else {"stage": np.array(rig.stage.T_rig_stage.matrix)}


def _of_joints(rows: _Rows, joints: Sequence[str], what: str, size: int) -> FloatArray:
    """Return `size` numbers (T, J, size) of each joint's `what`."""
    places = [("joints", joint, what, index) for joint in joints for index in range(size)]
    return rows.table(places).reshape(len(rows), len(joints), size)


def _skeleton(
    name: str, rows: _Rows, start_ns: int, joints: Sequence[str], angles: Sequence[tuple[str, str]]
) -> dict[str, Any]:
    """Return the attributes of a `JointTrack`; `angles` are named by part and angle."""
    return {
        "name": name,
        "t_ns": rows.t_ns,
        "start_ns": start_ns,
        "joint_names": tuple(joints),
        "positions": _of_joints(rows, joints, "position", 3),
        "orientations": _of_joints(rows, joints, "orientation", 4),
        "sigma": rows.table([("sigma", joint) for joint in joints]),
        "angle_names": tuple(angle_name(*angle) for angle in angles),
        "angles": rows.table([("angles", *angle) for angle in angles]),
        "state": rows.words(lambda pose: pose.state),
    }


def _hand(name: str, rows: _Rows, start_ns: int) -> HandTrack:
    states = [rows.words(lambda hand, finger=finger: hand.fingers.get(finger, "")) for finger in FINGERS]  # type: ignore[misc]
    return HandTrack(
        **_skeleton(name, rows, start_ns, JOINTS, HAND_ANGLES),
        radii=rows.table([("joints", joint, "radius") for joint in JOINTS]),
        angle_sigma=rows.table([("angle_sigma", *angle) for angle in HAND_ANGLES]),
        residuals=rows.table([("residual", finger) for finger in FINGERS]),
        finger_states=np.stack(states, axis=1),
    )


def _body(name: str, rows: _Rows, start_ns: int) -> JointTrack:
    there = set(rows.names(lambda body: body.joints))
    joints = [joint for joint in BODY_PARENTS if joint in there]
    return JointTrack(**_skeleton(name, rows, start_ns, joints, _BODY_ANGLES))


def _rigid(name: str, rows: _Rows, start_ns: int) -> RigidTrack:
    places: list[Place] = [(what, index) for what, size in _RIGID for index in range(size)]
    table = rows.table([*places, ("sigma",)])
    return RigidTrack(
        name=name,
        t_ns=rows.t_ns,
        start_ns=start_ns,
        positions=table[:, :3].copy(),
        orientations=table[:, 3:7].copy(),
        velocities=table[:, 7:10].copy(),
        sigma=table[:, 10].copy(),
        state=rows.words(lambda thing: thing.state),
        stage=rows.words(lambda thing: getattr(thing, "stage", "")),
        shape=getattr(rows.first, "shape", None),
    )


def _points(rows: _Rows, start_ns: int) -> dict[str, PointTrack]:
    found = {}
    for name in rows.names(lambda points: points.points):
        at: Place = ("points", name)
        places = [
            *((*at, "position", index) for index in range(3)),
            *((*at, "covariance", index) for index in range(6)),
            (*at, "sigma"),
            (*at, "views"),
        ]
        table = rows.table(places)

        def state(points: Any, name: str = name) -> str:
            return str(points.points[name].state) if name in points.points else ""

        found[name] = PointTrack(
            name=f"points/{name}",
            t_ns=rows.t_ns,
            start_ns=start_ns,
            positions=table[:, :3].copy(),
            covariances=table[:, 3:9][:, _FULL].reshape(-1, 3, 3),
            sigma=table[:, 9].copy(),
            views=np.nan_to_num(table[:, 10]).astype(np.int64),
            state=rows.words(state),
        )
    return found


# What cameras saw.

MarkerRow = tuple[str, int, Mapping[str, tuple[float, float, float, float]]]
"""Camera, time, and u, v, area, score of each marker."""


def _unpacked(payloads: Iterable[tuple[str, type[Message], list[bytes]]]) -> Iterator[MarkerRow]:
    for key, payload in ((key, payload) for key, _, several in payloads for payload in several):
        try:
            frame = unpack(payload)
            markers = {name: (m["u"], m["v"], m["area"], m["score"]) for name, m in frame["markers"].items()}
            yield key.rpartition("/")[2], int(frame["t_ns"]), markers
        except (WireError, KeyError, TypeError, ValueError, AttributeError):
            continue  # counted among the invalid by whoever tracks; here it shows nothing


def _rows_in(sources: Sequence[RecordedMessages], cameras: Sequence[str]) -> Iterator[MarkerRow]:
    for source in sources:
        yield from _unpacked(source.payloads(cameras))


def _given(rig: Rig | None) -> Rig | None:
    # A lambda could not be pickled.
    return rig


def _marker_tracks(seen: Callable[[], Iterable[MarkerRow]], start_ns: int) -> dict[str, MarkerTracks]:
    rows: dict[str, dict[int, Mapping[str, tuple[float, float, float, float]]]] = {}
    for camera, t_ns, markers in seen():
        rows.setdefault(camera, {})[t_ns] = markers
    found = {}
    for camera, frames in sorted(rows.items()):
        names = sorted({name for markers in frames.values() for name in markers})
        column = {name: index for index, name in enumerate(names)}
        table = np.full((len(frames), len(names), 4), np.nan)
        moments = sorted(frames)
        for row, t_ns in enumerate(moments):
            for name, values in frames[t_ns].items():
                table[row, column[name]] = values
        found[camera] = MarkerTracks(
            name=f"markers/{camera}",
            t_ns=np.array(moments, np.int64),
            start_ns=start_ns,
            marker_names=tuple(names),
            uv=table[..., :2].copy(),
            area=table[..., 2].copy(),
            score=table[..., 3].copy(),
        )
    return found
