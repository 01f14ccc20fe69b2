"""What people write in `rig.toml`, as frozen models that refuse unknown fields."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rhot.messages import Name, Side
from rhot.rig.calibration import DeskHeight
from rhot.rig.feet_config import BodyConfig, FeetConfig, WalkProgram
from rhot.rig.file_model import FileModel, HoldS, NotNegative, Positive, Vector3
from rhot.rig.sections import (
    PICTURE_NEUTRAL,
    BridgeConfig,
    Brightness,
    BusConfig,
    Contrast,
    Saturation,
    ShapeConfig,
    V4l2Control,
    check_shared_paints,
)
from rhot.rig.sections import MarkerConfig as MarkerConfig  # noqa: PLC0414 - others look for it here


class CameraConfig(FileModel):
    """One camera: where its pictures come from and how it is locked.

    Attributes:
        source: kind of source.
        device: V4L2 device (`/dev/video0` or its number), number of a webcam, or libcamera index.
        path: folder of pictures or video file, relative to the rig folder.
        width, height: pixels.
        rate_hz: frames per second.
        exposure_s: exposure time; short enough that a fast finger does not smear.
        gain: analogue gain.
        white_balance: red and blue gains; locked, never automatic.
        focus_dioptres: lens position, for cameras with a focus motor. V4L2 has no units for gain, white balance, focus.
        saturation, contrast, brightness: of the picture, where the camera can set them; 1, 1 and 0 leave it alone.
        v4l2_controls: what a V4L2 driver is set to, in its own units (`v4l2-ctl --list-ctrls`).
        readout_s: time between the read-out of the first and of the last row (rolling shutter).
        sync: libcamera's software synchronisation between Pis: who gives the beat.
        fov_deg: horizontal field of view, used until the cameras are calibrated.
        position_m: position of the camera in the rig frame, used until the cameras are calibrated.
        loop: start a folder or a video again at its end.
    """

    source: Literal["picamera2", "v4l2", "webcam", "images", "video", "simulated"] = "picamera2"
    device: int | str = 0
    path: str | None = None
    width: Annotated[int, Field(ge=16, le=8192)] = 640
    height: Annotated[int, Field(ge=16, le=8192)] = 480
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 60.0
    exposure_s: Annotated[float, Field(gt=0.0, le=1.0)] = 0.004
    gain: Annotated[float, Field(ge=1.0, le=64.0)] = 4.0
    white_balance: tuple[Positive, Positive] = (1.6, 1.6)
    focus_dioptres: NotNegative | None = None
    saturation: Saturation = 1.0
    contrast: Contrast = 1.0
    brightness: Brightness = 0.0
    v4l2_controls: dict[V4l2Control, Annotated[int, Field(ge=-(1 << 31), lt=1 << 31)]] = {}
    readout_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    sync: Literal["off", "server", "client"] = "off"
    fov_deg: Annotated[float, Field(gt=1.0, lt=170.0)] = 62.2
    position_m: Vector3 = (0.0, 0.0, 0.0)
    loop: bool = False

    @model_validator(mode="after")
    def _has_path(self) -> CameraConfig:
        if self.source in ("images", "video") and not self.path:
            raise ValueError(f'source = "{self.source}" needs `path`')
        twice = [name for name, neutral in PICTURE_NEUTRAL.items() if getattr(self, name) != neutral]
        if set(twice) & set(self.v4l2_controls):
            raise ValueError(f"{twice[0]} is set twice, here and in v4l2_controls; keep one")
        return self

    @property
    def video_path(self) -> str:
        """Path of a V4L2 device, which may be given by its number."""
        return f"/dev/video{self.device}" if str(self.device).isdecimal() else str(self.device)


class HandConfig(FileModel):
    """The hand until it is calibrated.

    Attributes:
        length_m: from the wrist crease to the tip of the middle finger; the default is an average adult's.
    """

    length_m: Annotated[float, Field(ge=0.10, le=0.26)] = 0.189


Options = Annotated[dict[Name, float | str | tuple[float, ...]], Field(max_length=32)]
"""Settings of a method that is not the rig's own; the method checks them."""


def _options_of_older_files(*names: str) -> Callable[[Any], Any]:
    """Return what moves fields that stood beside `method` in earlier versions into its options."""

    def moved(data: Any) -> Any:
        older = {name: data[name] for name in names if name in data} if isinstance(data, dict) else {}
        if not older:
            return data
        return {name: value for name, value in data.items() if name not in older} | {
            "options": older | dict(data.get("options", {}))
        }

    return moved


class FusionConfig(FileModel):
    """How two-dimensional markers become points.

    Attributes:
        method: `filter` (one Kalman filter for all markers of a hand, which takes each camera's frame at its own
            time), or an entry point `fusion.<method>` of `rhot.methods`; bench brings `triangulate` and `disparity`.
        options: of that other method; what it takes is its own affair.
        volume_m: lowest and highest x, y, z of a believable point, rig frame.
        hold_s: how long a marker is predicted after it was last measured.
        predict_s: `filter` publishes where the markers will be this much after the newest frame, such as the time
            until a display shows them.
        epipolar_limit_px: largest error across the epipolar lines that is learnt and corrected while running; cameras
            turn a little in their mounts.
    """

    method: Name = "filter"
    options: Options = {}
    volume_m: tuple[Vector3, Vector3] = ((-0.8, -0.6, 0.30), (0.8, 0.6, 1.40))
    hold_s: HoldS = 0.25
    predict_s: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    epipolar_limit_px: Annotated[float, Field(ge=0.0, le=1e4)] = 15.0

    _older_options = model_validator(mode="before")(
        _options_of_older_files(
            "depth_law",
            "one_euro",
            "min_cutoff_hz",
            "beta",
            "derivative_cutoff_hz",
            "pixel_min_cutoff_hz",
            "pixel_beta",
            "max_speed_m_s",
            "extrapolation",
        )
    )

    @model_validator(mode="after")
    def _ordered(self) -> FusionConfig:
        low, high = self.volume_m
        if any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"volume_m: each lower bound must be below its upper bound, got {low} and {high}")
        return self


class IkConfig(FileModel):
    """How points become a hand.

    Attributes:
        solver: of the fingers: `filter` (the whole hand with all its points in one filter), or, on the palm that this
            filter finds, each sample by itself: an entry point `ik.<solver>` of `rhot.methods`; bench brings `analytic`
            (closed form) and `fabrik` (iterative chain solver).
        options: of that other solver.
        hold_s: how long a hand is predicted after its last measured point.
    """

    solver: Name = "filter"
    options: Options = {}
    hold_s: HoldS = 0.5

    _older_options = model_validator(mode="before")(_options_of_older_files("tolerance_m", "max_iterations"))


ObjectSource = Literal["steamvr", "webxr", "recorded", "simulated"]


class ObjectConfig(FileModel):
    """One tracked object; the one with the id `head` is the headset and is published on `rhot/head`.

    Attributes:
        source: kind of source; `steamvr` finds trackers by serial number. As soon as one object has it, trackers that
            are not listed are published under their serial number, and the headset as `head`. `webxr` is a headset
            that has the page *Grasp* open: the objects `head` and `controller`, and no others.
        serial: serial number of the Vive tracker, or of any other device that SteamVR tracks.
        path: CSV file with `t_ns,x,y,z,qx,qy,qz,qw`, relative to the rig folder.
        rate_hz: how often the pose is asked for.
        loop: start the recording again at its end.
        shape: what fingers meet, about the object's own frame: its middle is the pose, see `T_tracker_object` of
            `registration.json`. Not known where absent.
    """

    source: ObjectSource = "steamvr"
    serial: str | None = None
    path: str | None = None
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 90.0
    loop: bool = False
    shape: ShapeConfig | None = None

    @model_validator(mode="after")
    def _has_origin(self) -> ObjectConfig:
        if self.source == "steamvr" and not self.serial:
            raise ValueError('source = "steamvr" needs `serial`, printed on the tracker and shown by SteamVR')
        if self.source == "recorded" and not self.path:
            raise ValueError('source = "recorded" needs `path`')
        return self


class SimConfig(FileModel):
    """The simulated world that simulated cameras and objects show.

    Attributes:
        seed: of the whole world; with the time it determines everything.
        noise_sigma: of the sensor, grey levels.
        light_drift: relative amplitude of slow brightness changes.
        drop_rate: share of frames that a camera loses.
        clock_offset_s, clock_drift_ppm: largest error of a camera node's clock.
        jitter_s: standard deviation of a frame's delivery.
        phase_s: cameras are this much out of step with one another.
        motion: `script` (gestures and grasps), `still` (open hands that never move), `crossing` (two hands touch and
            cross), `board` (no hands: a chessboard is held at one place after the other, for calibrating the cameras),
            `desk_board` (it lies on the desk, for finding the floor) or `touch` (a finger touches the faces of a box,
            for finding where its tracker sits) or `headset` (a rig of feet: a marker lies on the floor, and the camera
            sits askew on the headset).
        walk: what the person does whose feet are tracked, where the rig has [feet].
        board_columns, board_rows: inner corners of that chessboard.
        board_square_m: side of its squares.
        desk_z_m: distance of the desk from the reference camera.
        desk_height_m: height of the desk over the floor.
    """

    seed: Annotated[int, Field(ge=0, lt=1 << 63)] = 1
    noise_sigma: Annotated[float, Field(ge=0.0, le=255.0)] = 3.0
    light_drift: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.04
    drop_rate: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.02
    clock_offset_s: NotNegative = 0.2
    clock_drift_ppm: Annotated[float, Field(ge=0.0, le=1e4)] = 40.0
    jitter_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0005
    phase_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.007
    motion: Literal["script", "still", "crossing", "board", "desk_board", "touch", "headset"] = "script"
    walk: WalkProgram = "walk"
    board_columns: Annotated[int, Field(ge=3, le=60)] = 9
    board_rows: Annotated[int, Field(ge=3, le=60)] = 6
    board_square_m: Annotated[float, Field(ge=0.001, le=0.5)] = 0.025
    desk_z_m: Annotated[float, Field(ge=0.5, le=2.0)] = 0.95
    desk_height_m: DeskHeight = 0.74


class RigConfig(FileModel):
    """The whole of `rig.toml`.

    Attributes:
        version: of this file's layout.
        name: of the rig, for people.
        autostart: `rhot start --auto`, which the installed services run, starts a session by itself.
        cameras: by name; the first is the reference that defines the rig frame until calibration. None in a rig that
            tracks feet alone.
        markers: by name, as painted; some as soon as there are cameras.
        bus, hand, fusion, ik: settings of the parts; each may be left out.
        objects: tracked objects by id.
        feet: feet tracked from the head; left out when there are none.
        body: the person whose legs are solved.
        bridges: other programs that are sent what is tracked, by a name of one's own; `rhot up` starts them.
        sim: the simulated world, for simulated cameras and objects alone.
    """

    version: Literal[1] = 1
    name: str = "rig"
    autostart: bool = False
    bus: BusConfig = BusConfig()
    cameras: Annotated[dict[Name, CameraConfig], Field(max_length=64)] = {}
    markers: Annotated[dict[Name, MarkerConfig], Field(max_length=64)] = {}
    hand: HandConfig = HandConfig()
    fusion: FusionConfig = FusionConfig()
    ik: IkConfig = IkConfig()
    objects: Annotated[dict[Name, ObjectConfig], Field(max_length=64)] = {}
    feet: FeetConfig | None = None
    body: BodyConfig = BodyConfig()
    bridges: Annotated[dict[Name, BridgeConfig], Field(max_length=16)] = {}
    sim: SimConfig = SimConfig()

    @model_validator(mode="after")
    def _tracks_something(self) -> RigConfig:
        if not self.cameras and (self.markers or self.feet is None):
            raise ValueError("no camera: name at least one [cameras.<name>]; only a rig with [feet] alone needs none")
        if self.cameras and not self.markers:
            raise ValueError("no marker: name at least one [markers.<name>] for the cameras to look for")
        if self.feet and "feet" in self.cameras:
            raise ValueError("cameras.feet: with [feet], `feet` is the name of the feet's depth camera; choose another")
        return self

    @model_validator(mode="after")
    def _one_marker_per_joint(self) -> RigConfig:
        seen: dict[tuple[str, str], str] = {}
        for name, marker in self.markers.items():
            joint = (marker.hand, marker.joint)
            if joint in seen:
                raise ValueError(
                    f"markers.{name} and markers.{seen[joint]} both mark {marker.joint} of the {marker.hand} hand"
                )
            seen[joint] = name
        return self

    @model_validator(mode="after")
    def _hands_can_be_told_apart(self) -> RigConfig:
        check_shared_paints(self.markers)
        return self

    @model_validator(mode="after")
    def _headset_is_head_and_controller(self) -> RigConfig:
        strange = [
            n for n, thing in self.objects.items() if thing.source == "webxr" and n not in ("head", "controller")
        ]
        if strange:
            raise ValueError(f'objects.{strange[0]}: source = "webxr" tracks `head` and `controller`, nothing else')
        return self

    @property
    def sides(self) -> tuple[Side, ...]:
        """Hands that wear markers, right before left."""
        worn = {marker.hand for marker in self.markers.values()}
        return tuple(side for side in ("right", "left") if side in worn)
