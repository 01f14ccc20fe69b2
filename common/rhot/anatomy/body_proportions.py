"""An adult's body in numbers: lengths between joints, from the body's height where nobody measured them.

Thigh 0.245 H, shank 0.246 H, ankle 0.039 H above the floor, foot 0.152 H long, upper arm 0.186 H, forearm 0.146 H,
shoulders at 0.818 H and 0.259 H apart and eyes at 0.936 H are Drillis &
Contini, "Body Segment Parameters", 1966, as reprinted in Winter, "Biomechanics and Motor Control of Human Movement",
fig. 4.1; quoted from memory of that figure, its sum (hips at 0.530 H) and the eyes' height (0.935 H for the median man
in Huston, "Principles of Biomechanics", 2009) agree. That figure's hip width of 0.191 H is the outer one. The distance
of the hip joints, where ankle and ball stand in the foot, and how the head sits on the neck are choices that match
average adults and come from no table.

How the trunk divides is de Leva, "Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters", Journal of
Biomechanics 29 (9), 1996, table 4, men: from the middle between the hips to the navel 145.7 mm, on to the xiphoid
215.5 mm, on to the seventh neck vertebra 242.1 mm; quoted from memory, too.

Frames as in `rhot.messages.BodyPose`: +X to the body's right, +Y up, +Z backwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np

from rhot.arrays import FloatArray

THIGH: Final = 0.245
SHANK: Final = 0.246
ANKLE_HEIGHT: Final = 0.039
FOOT_LENGTH: Final = 0.152
EYE_HEIGHT: Final = 0.936
HIP_WIDTH: Final = 0.100
NECK_BELOW_EYES: Final = 0.060
NECK_BEHIND_EYES: Final = 0.050
SKULL_BELOW_EYES: Final = 0.012
"""The skull's base, on which the head nods, straight above the neck's pivot."""
UPPER_ARM: Final = 0.186
FOREARM: Final = 0.146
SHOULDER_BELOW_NECK: Final = 0.058
SHOULDER_OUTWARDS: Final = 0.129
HIPS_BELOW_NECK: Final = EYE_HEIGHT - NECK_BELOW_EYES - ANKLE_HEIGHT - SHANK - THIGH
"""As shares of the body's height."""
_TRUNK_MM: Final = (145.7, 215.5, 242.1)
SPINE_SHARES: Final[tuple[float, float, float]] = (
    _TRUNK_MM[0] / sum(_TRUNK_MM),
    _TRUNK_MM[1] / sum(_TRUNK_MM),
    _TRUNK_MM[2] / sum(_TRUNK_MM),
)
"""Of the way from the hips to the neck: up to `spine_lower` (height of the navel), `chest` (xiphoid) and `neck`."""
HEEL_SHARE: Final = 0.25
BALL_SHARE: Final = 0.47
"""How far the heel's end lies behind the ankle and the ball of the foot in front of it, as shares of the foot."""


class BodyMeasures(Protocol):
    """What is known of a person; `rhot.rig.BodyConfig` is one. What is None follows from the height."""

    @property
    def height_m(self) -> float:
        """Standing, without shoes."""
        ...

    @property
    def hip_width_m(self) -> float | None:
        """Between the hip joints."""
        ...

    @property
    def thigh_m(self) -> float | None:
        """Hip to knee."""
        ...

    @property
    def shank_m(self) -> float | None:
        """Knee to ankle."""
        ...

    @property
    def upper_arm_m(self) -> float | None:
        """Shoulder to elbow."""
        ...

    @property
    def forearm_m(self) -> float | None:
        """Elbow to wrist."""
        ...


@dataclass(frozen=True, slots=True)
class BodyModel:
    """A person: lengths of legs and arms, and where head and shoulders are over the hips.

    Attributes:
        height_m: standing, without shoes.
        hip_width_m: between the hip joints.
        thigh_m, shank_m: hip to knee, knee to ankle.
        ankle_height_m: ankle joint over the bare sole.
        foot_length_m: heel to toes.
        neck_height_m: from the middle between the hips up to the pivot of the head, standing upright.
        neck_m: position of that pivot in the frame of the headset, whose origin lies between the eyes.
        skull_m: the same of the skull's base.
        upper_arm_m, forearm_m: shoulder to elbow, elbow to wrist.
        shoulder_m: position of the right shoulder in the chest's axes, from the neck's pivot.
    """

    height_m: float
    hip_width_m: float
    thigh_m: float
    shank_m: float
    ankle_height_m: float
    foot_length_m: float
    neck_height_m: float
    neck_m: tuple[float, float, float]
    skull_m: tuple[float, float, float]
    upper_arm_m: float
    forearm_m: float
    shoulder_m: tuple[float, float, float]

    @classmethod
    def from_config(cls, config: BodyMeasures) -> BodyModel:
        """Return the person of a `rig.toml`; lengths that are left out follow from the height."""
        height = config.height_m
        return cls(
            height_m=height,
            hip_width_m=config.hip_width_m or HIP_WIDTH * height,
            thigh_m=config.thigh_m or THIGH * height,
            shank_m=config.shank_m or SHANK * height,
            ankle_height_m=ANKLE_HEIGHT * height,
            foot_length_m=FOOT_LENGTH * height,
            neck_height_m=HIPS_BELOW_NECK * height,
            neck_m=(0.0, -NECK_BELOW_EYES * height, NECK_BEHIND_EYES * height),
            skull_m=(0.0, -SKULL_BELOW_EYES * height, NECK_BEHIND_EYES * height),
            upper_arm_m=config.upper_arm_m or UPPER_ARM * height,
            forearm_m=config.forearm_m or FOREARM * height,
            shoulder_m=(SHOULDER_OUTWARDS * height, -SHOULDER_BELOW_NECK * height, 0.0),
        )

    def lengthened(self, legs_m: float, trunk_m: float) -> BodyModel:
        """Return the person with legs and trunk longer by this much; thigh and shank keep their ratio."""
        share = 1.0 + legs_m / self.leg_m
        return replace(
            self,
            thigh_m=share * self.thigh_m,
            shank_m=share * self.shank_m,
            neck_height_m=self.neck_height_m + trunk_m,
        )

    @property
    def leg_m(self) -> float:
        """Hip to ankle of the straight leg."""
        return self.thigh_m + self.shank_m

    @property
    def ball_m(self) -> FloatArray:
        """(3,) the ball of the foot in the frame of the ankle, whose axes are level when the foot stands flat."""
        return np.array([0.0, -0.6 * self.ankle_height_m, -BALL_SHARE * self.foot_length_m])

    @property
    def heel_m(self) -> float:
        """How far the heel's end lies behind the ankle."""
        return HEEL_SHARE * self.foot_length_m
