"""A recording as an `.rrd` file that Rerun opens: hands, points, objects, cameras with their pictures and markers."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from rhot.anatomy.skeleton import PARENTS, angle_name
from rhot.atomic_file import replacing
from rhot.errors import ConfigError
from rhot.messages import HandPose, MarkerFrame, Message, ObjectPose, PointSet
from rhot.plugins import load_library
from rhot.rig import CameraCalibration
from rhot_tools.recordings.beside import StoredPicture

TIMELINE: Final = "rig_time"
_MEASURED: Final = (42, 157, 143)
_PREDICTED: Final = (233, 140, 42)
_POINT_M: Final = 0.005
_BONE_M: Final = 0.002


def write_rerun(
    file: Path,
    messages: Iterable[tuple[str, Message]],
    cameras: dict[str, CameraCalibration],
    pictures: Iterable[StoredPicture],
) -> int:
    """Write a file and return how many messages are in it; see `write_foxglove`.

    Raises:
        ConfigError: rerun is not installed, or the file cannot be written.
    """
    rerun = load_library("rerun", "--rerun", "rerun")
    if not file.parent.is_dir():
        raise ConfigError(f"{file}: the folder {file.parent} does not exist")
    with replacing(file) as part:
        return _write(rerun, part, file.stem, messages, cameras, pictures)


def _write(
    rerun: Any,
    file: Path,
    title: str,
    messages: Iterable[tuple[str, Message]],
    cameras: dict[str, CameraCalibration],
    pictures: Iterable[StoredPicture],
) -> int:
    stream = rerun.RecordingStream("rhot", recording_id=title)
    stream.save(file)
    # Cameras look down: what they see is far along z, and what is up in their pictures is towards −y.
    stream.log("rig", rerun.ViewCoordinates.RDF, static=True)
    for name, camera in cameras.items():
        T = np.array(camera.T_rig_camera)
        stream.log(f"rig/{name}", rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
        plane_m = 0.1
        lens = rerun.Pinhole(
            image_from_camera=np.array(camera.K),
            resolution=[camera.width, camera.height],
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=plane_m,
        )
        stream.log(f"rig/{name}/image", lens, static=True)
    count = 0
    for key, message in messages:
        if message.t_ns and (parts := _parts(rerun, key, message)):
            stream.set_time(TIMELINE, timestamp=np.datetime64(message.t_ns, "ns"))
            for path, part in parts:
                stream.log(path, part)
            count += 1
    for picture in pictures:
        stream.set_time(TIMELINE, timestamp=np.datetime64(picture.t_ns, "ns"))
        stream.log(f"rig/{picture.camera}/image", rerun.EncodedImage(path=picture.file))
    stream.flush()
    stream.disconnect()
    if not file.stat().st_size:
        # Rerun writes on a thread of its own and only logs when it cannot.
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    return count


def _parts(rerun: Any, key: str, message: Message) -> list[tuple[str, Any]]:
    path = f"rig/{key.removeprefix('rhot/')}"
    match message:
        case HandPose():
            color = _MEASURED if message.state == "measured" else _PREDICTED
            joints = message.joints
            bones = [
                [joints[parent].position, joints[joint].position]
                for joint, parent in PARENTS.items()
                if parent in joints and joint in joints
            ]
            balls = rerun.Points3D(
                [joint.position for joint in joints.values()],
                radii=[joint.radius for joint in joints.values()],
                colors=color,
            )
            return [
                (f"{path}/joints", balls),
                (f"{path}/bones", rerun.LineStrips3D(bones, radii=_BONE_M, colors=color)),
                *(
                    (f"angles/{angle_name(finger, name)}", rerun.Scalars(float(np.degrees(angle))))
                    for finger, angles in message.angles.items()
                    for name, angle in angles
                ),
            ]
        case PointSet():
            points = message.points
            colors = [_MEASURED if point.state == "measured" else _PREDICTED for point in points.values()]
            positions = [point.position for point in points.values()]
            return [(path, rerun.Points3D(positions, radii=_POINT_M, colors=colors, labels=list(points)))]
        case ObjectPose():
            pose = rerun.Transform3D(
                translation=message.position, quaternion=rerun.Quaternion(xyzw=message.orientation)
            )
            return [(path, pose)]
        case MarkerFrame():
            # Rerun's pixel centres are on halves.
            centres = [(marker.u + 0.5, marker.v + 0.5) for marker in message.markers.values()]
            return [(f"rig/{message.camera}/image/markers", rerun.Points2D(centres, labels=list(message.markers)))]
        case _:
            return []
