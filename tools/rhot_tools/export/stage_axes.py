"""Which frame an export stands in: the stage (y up, origin on the floor) where it is known, else the rig's own.

A recording of `rhot record` holds what was published on `rhot/space/stage`; the last of it counts. Else the rig folder
knows, the one that is named or the one inside the recording.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.transforms import inverse
from rhot.messages import Message, Space
from rhot.rig import Rig

STAGE_KEY = "rhot/space/stage"
NO_STAGE = (
    "no floor is known: the file is in the rig's own frame, whose axes are those of the first camera; `rhot calibrate "
    "stage` finds the floor, --rig names a rig folder that knows it"
)


def stage_of(messages: Iterable[tuple[str, Message]], rig: Rig | None) -> FloatArray | None:
    """Return T_stage_rig (4, 4), metres; None where nobody knows it."""
    spaces = [message for key, message in messages if key == STAGE_KEY and isinstance(message, Space)]
    if spaces:
        return inverse(np.array(spaces[-1].T_rig_space))
    if rig is not None and rig.stage is not None:
        return inverse(rig.stage.T_rig_stage.matrix)
    return None
