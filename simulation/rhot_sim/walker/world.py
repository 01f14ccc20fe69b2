"""The walking person's world: truth, the depth camera's pictures and the ankle sensors, from seed and time alone.

The rig frame is the headset's tracking space with +y up and the floor at y = 0; the person starts at the origin and
faces -z. Times are seconds since the world's start.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cached_property, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.aruco_dictionary import marker_cells
from rhot.errors import ConfigError
from rhot.geometry.rotations import rigid, rotation_from_vector, rotation_x, rotation_y
from rhot.messages import Side, Truth
from rhot.rig.feet_config import DepthCameraConfig, FeetConfig, FootConfig
from rhot.rig.folder import Rig
from rhot_sim.rendering.backdrop import SensorNoise
from rhot_sim.walker.foot_path import SIDES
from rhot_sim.walker.imu import AnkleImu, ImuErrors
from rhot_sim.walker.person import Person, PersonSample, person_of, transforms
from rhot_sim.walker.pictures.camera import FrameTiming, frame_timing, intrinsics
from rhot_sim.walker.pictures.color import Card, ColorRenderer, DrawnScene, Image
from rhot_sim.walker.pictures.depth import CARD_SHARE, DepthImage, DepthRenderer, limbs_at
from rhot_sim.walker.pictures.disturbances import Disturbances, Mishaps
from rhot_sim.walker.programs import LOOK_AT_MARKER
from rhot_sim.world.motion import true_pose
from rhot_sim.world.script import seeded

INSTEP_RAD: Final = float(np.radians(18.0))
"""How far the marker on the instep is tilted, toes down, while the foot stands flat."""
ANKLE_ERROR_M: Final = 0.004
"""Standard deviation per axis between the true place of the ankle behind the marker and the configured one."""
EXPOSURE_S: Final = 0.006
NOISE_SIGMA: Final = 2.5
LIGHT_DRIFT: Final = 0.06
_FLICKER: Final = 0.015
_MAINS_HZ: Final = 100.0
_MAX_MOMENTS: Final = 4
_STILL_PX: Final = 0.4
_PX_PER_MOMENT: Final = 2.0
_STREAM: Final = 43
_ASKEW_RAD: Final = float(np.radians(4.0))
"""By how much a pose that somebody typed in is off, about each axis: a guess by eye."""
_ASKEW_M: Final = 0.02
_PAPER_M: Final = 0.001
"""Height of a marker that lies on the floor."""

DEFAULT_FEET: Final = FeetConfig(
    camera=DepthCameraConfig(source="simulated"), left=FootConfig(marker_id=0), right=FootConfig(marker_id=1)
)


class WalkerWorld:
    """A person who carries out a program, with a depth camera on the head, markers on the feet and ankle sensors.

    Args:
        seed: with the time it determines everything.
        body: the person's true lengths.
        program: one of `rhot_sim.walker.programs.PROGRAMS`.
        feet: camera, markers and sensors.
        disturbances: of the pictures; hems alone when not given.
        imu_errors: of the ankle sensors; a BNO080's when not given.
        noise: scales the noise of colour and depth.
        askew: the camera does not sit where `feet` says, by some degrees and centimetres that follow from the seed, and
            the left foot's marker lies on the floor in front of the feet, which wear none.
    """

    def __init__(
        self,
        seed: int,
        body: BodyModel,
        program: str = "walk",
        *,
        feet: FeetConfig = DEFAULT_FEET,
        disturbances: Disturbances | None = None,
        imu_errors: ImuErrors | None = None,
        noise: float = 1.0,
        askew: bool = False,
    ) -> None:
        self.seed = seed
        self.body = body
        self.feet_config = feet
        self.person = Person(seed, body, program, np.radians(feet.camera.pitch_deg))
        self.intrinsics = intrinsics(feet.camera)
        self.T_head_camera = feet.camera.T_head_camera
        if askew:
            self.T_head_camera = self.T_head_camera @ _askew(seeded(seed, _STREAM, 4))
        self._mishaps = Mishaps(seed, disturbances or Disturbances())
        rng = seeded(seed, _STREAM)
        self._T_ankle_foot = {side: self._marker_on_foot(side, rng) for side in SIDES}
        self._noise = noise
        self._lamp_phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        self._cells = {side: marker_cells(feet.dictionary, foot.marker_id) for side, foot in feet.feet.items()}
        self.on_floor: list[Card] = []
        if askew:
            # Laid down by hand: anywhere there, at any angle.
            yaw, x, z = seeded(seed, _STREAM, 5).uniform((-0.5, -0.08, -0.55), (0.5, 0.08, -0.4))
            T_rig_marker = rigid(rotation_y(yaw), np.array([x, _PAPER_M, z]))
            self.on_floor = [Card(T_rig_marker, next(iter(self._cells.values())), feet.marker_size_m)]
            self._cells = {}
        self._imus = {
            side: AnkleImu(
                seed,
                side,
                partial(self.person.ankles, side),
                self.person.feet[side].steps,
                self.person.period_s,
                _imu_rate_hz(feet, side),
                imu_errors,
            )
            for side in SIDES
        }

    # Drawn when first needed: whoever asks for the truth alone draws no floor.
    @cached_property
    def _color(self) -> ColorRenderer:
        camera = self.feet_config.camera
        return ColorRenderer(self.intrinsics, camera.width, camera.height, seeded(self.seed, _STREAM, 1))

    @cached_property
    def _depth(self) -> DepthRenderer:
        camera = self.feet_config.camera
        rng = seeded(self.seed, _STREAM, 2)
        return DepthRenderer(self.intrinsics, camera.width, camera.height, rng, self._noise)

    @cached_property
    def _sensor_noise(self) -> SensorNoise:
        camera = self.feet_config.camera
        rng = seeded(self.seed, _STREAM, 3)
        return SensorNoise(camera.width, camera.height, self._noise * NOISE_SIGMA, rng)

    @classmethod
    def from_rig(cls, rig: Rig) -> WalkerWorld:
        """Build the world that a rig folder describes; the person's lengths differ a little from the average ones.

        Raises:
            ConfigError: `rig.toml` has no [feet].
        """
        config = rig.config
        if config.feet is None:
            raise ConfigError(f"{rig.path / 'rig.toml'}: no [feet], so nobody walks; add [feet.left] with marker_id")
        body = person_of(BodyModel.from_config(config.body), config.sim.seed)
        askew = config.sim.motion == "headset"
        program = LOOK_AT_MARKER if askew else config.sim.walk
        return cls(config.sim.seed, body, program, feet=config.feet, askew=askew)

    def head(self, t_s: FloatArray) -> FloatArray:
        """Return T_rig_head (N, 4, 4) at times (N,)."""
        return self.person.heads(_times(t_s))

    def feet(self, t_s: FloatArray) -> dict[Side, FloatArray]:
        """Return T_rig_foot (N, 4, 4) of both feet, the frame of `rhot.messages.FootPose`, at times (N,)."""
        t = _times(t_s)
        return {side: self.person.ankles(side, t) @ self._T_ankle_foot[side] for side in SIDES}

    def flat(self, side: Side, t_s: FloatArray) -> NDArray[np.bool_]:
        """Tell (N,) when a foot rests on its whole sole and does not move at all."""
        return self.person.flat(side, _times(t_s))

    def joints(self, t_s: FloatArray) -> dict[str, FloatArray]:
        """Return the poses (N, 4, 4) of hips and legs, names and frames as in `rhot.messages.BodyPose`."""
        return self._joints(self.person.sample(_times(t_s)))

    def truth(self, t_s: float, t_ns: int, seq: int = 0) -> Truth:
        """Return what is true at `t_s` as the message with time stamp `t_ns`; feet that wear no marker are left out."""
        t = np.array([t_s])
        sample = self.person.sample(t)
        feet = self.feet(t)
        return Truth(
            t_ns=t_ns,
            seq=seq,
            frame="rig",
            points={},
            hands={},
            objects={},
            head=true_pose(sample.head[0]),
            feet={side: true_pose(feet[side][0]) for side in self.feet_config.feet},
            body={name: true_pose(T[0]) for name, T in self._joints(sample).items()},
        )

    def timing(self, index: int) -> FrameTiming:
        """Return when a frame of the camera is exposed and delivered, and whether it is lost."""
        return frame_timing(self.seed, self.feet_config.camera.rate_hz, index)

    def frame(self, index: int) -> tuple[float, Image, DepthImage]:
        """Return a frame of the depth camera by its number, lost or not.

        Returns:
            Middle of the exposure, seconds; colour (H, W, 3) uint8, blue green red; depth (H, W) uint16, millimetres
            along the optical axis, aligned to colour, 0 = none.
        """
        t_s = self.timing(index).t_s
        color, depth = self.render(t_s)
        return t_s, color, depth

    def render(self, t_s: float) -> tuple[Image, DepthImage]:
        """Return colour and depth as of `frame`, exposed around any time."""
        moments = self._moments(t_s)
        times = np.concatenate([moments, [t_s]])
        sample = self.person.sample(times)
        cameras = sample.head @ self.T_head_camera
        feet = {side: sample.ankles[side] @ self._T_ankle_foot[side] for side in SIDES}
        scenes = [self._scene(sample, cameras, feet, moment, t_s) for moment in range(len(moments))]
        color = self._color.render(scenes, self._light(t_s))
        key = f"{self.seed} {round(t_s * 1e9)}"
        digest = hashlib.blake2b(key.encode(), digest_size=4).digest()
        self._sensor_noise.add(color, int.from_bytes(digest, "big"))
        limbs = limbs_at(self.person, sample, len(moments))
        cards = [self._card_pose(feet[side][-1]) for side in self._cells]
        return color, self._depth.render(cameras[-1], limbs.cones, cards, key)

    def project(self, points: FloatArray, t_s: float) -> FloatArray:
        """Return pixels (N, 2) of rig points (N, 3) in the picture of a time; NaN where not in front of the camera."""
        return self._color.project((self.head(np.array([t_s])) @ self.T_head_camera)[0], points)

    def imu(self, side: Side, t0_s: float, t1_s: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return what an ankle sensor measures from `t0_s` to before `t1_s`; see `AnkleImu.samples`."""
        return self._imus[side].samples(t0_s, t1_s)

    def imu_delivered_s(self, side: Side, t_s: FloatArray) -> FloatArray:
        """Return when samples with these time stamps (N,) reach this machine."""
        return self._imus[side].delivered_s(t_s)

    def T_foot_sensor(self, side: Side) -> FloatArray:
        """Return how a foot's sensor is turned and placed against its marker, (4, 4); a tracker does not know it."""
        T: FloatArray = np.linalg.inv(self._T_ankle_foot[side]) @ self._imus[side].T_ankle_sensor
        return T

    def _marker_on_foot(self, side: Side, rng: np.random.Generator) -> FloatArray:
        """Return T_ankle_foot: the marker lies on the instep, so that the ankle is where `ankle_m` says, nearly."""
        foot = self.feet_config.feet.get(side)
        ankle_m = np.array(foot.ankle_m if foot else FootConfig(marker_id=0).ankle_m)
        R = rotation_x(-INSTEP_RAD)
        return rigid(R, -R @ (ankle_m + rng.normal(0.0, ANKLE_ERROR_M, 3)))

    def _moments(self, t_s: float) -> FloatArray:
        """Return the moments of an exposure to draw: as many as the motion in the picture asks for."""
        ends = np.array([t_s - EXPOSURE_S / 2.0, t_s + EXPOSURE_S / 2.0])
        cameras = self.head(ends) @ self.T_head_camera
        feet = self.feet(ends)
        # The feet, and a point of the floor before them for the turning of the head.
        floor = (feet["left"][0, :3, 3] + feet["right"][0, :3, 3]) / 2.0
        moved = [
            self._color.project(camera, np.stack([feet["left"][end, :3, 3], feet["right"][end, :3, 3], floor]))
            for end, camera in enumerate(cameras)
        ]
        blur_px = float(np.nan_to_num(np.linalg.norm(moved[1] - moved[0], axis=1), nan=0.0).max())
        count = 1 if blur_px < _STILL_PX else min(_MAX_MOMENTS, 1 + int(np.ceil(blur_px / _PX_PER_MOMENT)))
        moments: FloatArray = ends[0] + EXPOSURE_S * (np.arange(count) + 0.5) / count
        return moments

    def _scene(
        self, sample: PersonSample, cameras: FloatArray, feet: Mapping[Side, FloatArray], moment: int, t_s: float
    ) -> DrawnScene:
        size_m = self.feet_config.marker_size_m
        cells = dict(self._cells)
        litter = [*self.on_floor]
        false = self._mishaps.false_marker(t_s, lambda side, at_s: self.feet(np.array([at_s]))[side][0])
        if false is not None and false.side in self._cells:
            if false.T_rig_foot is None:
                cells = dict.fromkeys(cells, self._cells[false.side])
            else:
                litter.append(Card(false.T_rig_foot, self._cells[false.side], size_m * false.size_share))
        cards = {
            side: Card(feet[side][moment], cells[side], size_m, self._mishaps.covered(side, t_s)) for side in cells
        }
        return DrawnScene(cameras[moment], limbs_at(self.person, sample, moment), cards, litter)

    def _card_pose(self, T_rig_foot: FloatArray) -> FloatArray:
        card = T_rig_foot.copy()
        card[:3, [0, 2]] *= CARD_SHARE * self.feet_config.marker_size_m / 2.0
        return card

    def _light(self, t_s: float) -> float:
        """Return the lamp's brightness, 1 on average: slow drift, and the mains' flicker as the frames catch it."""
        first, second, third = self._lamp_phase
        slow = 0.7 * np.sin(2.0 * np.pi * t_s / 17.0 + first) + 0.3 * np.sin(2.0 * np.pi * t_s / 4.1 + second)
        return float(1.0 + LIGHT_DRIFT * slow + _FLICKER * np.sin(2.0 * np.pi * _MAINS_HZ * t_s + third))

    def _joints(self, sample: PersonSample) -> dict[str, FloatArray]:
        joints = {"hips": sample.hips}
        for side in SIDES:
            ankle, leg = sample.ankles[side], sample.legs[side]
            ball = ankle.copy()
            ball[:, :3, 3] += ankle[:, :3, :3] @ self.body.ball_m
            joints[f"{side}_hip"] = transforms(leg.R_thigh, sample.hip_joints[side])
            joints[f"{side}_knee"] = transforms(leg.R_shank, leg.knee)
            joints[f"{side}_ankle"] = ankle
            joints[f"{side}_foot"] = ball
        return joints


def _askew(rng: np.random.Generator) -> FloatArray:
    """Return how a camera sits against where a person thinks that it does, (4, 4)."""
    turned = rng.uniform(-_ASKEW_RAD, _ASKEW_RAD, 3)
    return rigid(rotation_from_vector(turned), rng.uniform(-_ASKEW_M, _ASKEW_M, 3))


def _imu_rate_hz(feet: FeetConfig, side: Side) -> float:
    foot = feet.feet.get(side)
    return foot.imu.rate_hz if foot and foot.imu else 100.0


def _times(t_s: FloatArray) -> FloatArray:
    return np.asarray(t_s, dtype=np.float64).reshape(-1)
