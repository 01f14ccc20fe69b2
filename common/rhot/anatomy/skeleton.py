"""The hand's joints in OpenXR's terms: names, chains and parents (XR_EXT_hand_tracking); at the end those of the body.

Joint axes: +Z points from the tip to the wrist, +Y out of the back of the hand, +X to the right for either hand
when the palm faces down.
"""

from typing import Final

FINGERS: Final = ("thumb", "index", "middle", "ring", "little")

THUMB_JOINTS: Final = ("thumb_metacarpal", "thumb_proximal", "thumb_distal", "thumb_tip")
_FINGER_SEGMENTS: Final = ("metacarpal", "proximal", "intermediate", "distal", "tip")

CHAINS: Final[dict[str, tuple[str, ...]]] = {
    finger: THUMB_JOINTS if finger == "thumb" else tuple(f"{finger}_{segment}" for segment in _FINGER_SEGMENTS)
    for finger in FINGERS
}
"""Joints of each finger from the palm outwards."""

JOINTS: Final[tuple[str, ...]] = ("palm", "wrist", *(joint for finger in FINGERS for joint in CHAINS[finger]))
"""All 26 joints in OpenXR's order."""

PARENTS: Final[dict[str, str | None]] = {
    "wrist": None,
    "palm": "wrist",
    **{
        joint: "wrist" if index == 0 else chain[index - 1]
        for chain in CHAINS.values()
        for index, joint in enumerate(chain)
    },
}

BODY_PARENTS: Final[dict[str, str | None]] = {
    "hips": None,
    "spine_lower": "hips",
    "chest": "spine_lower",
    "neck": "chest",
    "head": "neck",
    **{
        f"{side}_{joint}": parent if parent in ("hips", "chest") else f"{side}_{parent}"
        for side in ("left", "right")
        for joint, parent in (
            ("hip", "hips"),
            ("knee", "hip"),
            ("ankle", "knee"),
            ("foot", "ankle"),
            ("shoulder", "chest"),
            ("elbow", "shoulder"),
            ("wrist", "elbow"),
        )
    },
}
"""The joints of `rhot/body` and their parents, parents first. Names are OpenXR's: of `hips`, spine and head those of
XR_FB_body_tracking, of legs and arms those of XR_BD_body_tracking (whose pelvis the hips are)."""


# Angles of fingers by name.

FINGER_ANGLES: Final = ("mcp_flexion", "mcp_abduction", "pip_flexion", "dip_flexion")
"""Of each finger, in messages."""
_THUMB: Final = dict(zip(FINGER_ANGLES, ("cmc_flexion", "cmc_abduction", "mcp_flexion", "ip_flexion"), strict=True))
"""The thumb's joints by their anatomical names: its chain begins one joint earlier and ends in a single IP joint."""


def angle_name(part: str, angle: str) -> str:
    """Return the name of a joint angle in files, such as `index_mcp_flexion`, `thumb_cmc_flexion`, `left_knee_flexion`.

    Messages give every finger the same four names; in files the thumb's are those of its own joints.
    """
    return f"{part}_{_THUMB[angle] if part == 'thumb' else angle}"


HAND_ANGLES: Final = tuple((finger, angle) for finger in FINGERS for angle in FINGER_ANGLES)
"""(20,) finger and angle of a hand, in the order of `rhot.anatomy.hand`."""
HAND_ANGLE_NAMES: Final = tuple(angle_name(finger, angle) for finger, angle in HAND_ANGLES)
"""(20,) their names in files."""
