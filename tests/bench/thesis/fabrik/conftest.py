"""The hand that the chains are made of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray
from rhot.rig import HandFile


@pytest.fixture
def right_hand() -> HandModel:
    return HandModel.from_file(HandFile(), "right")


@pytest.fixture
def random_angles() -> Callable[[HandModel, int, int], FloatArray]:
    def legal(model: HandModel, seed: int, count: int) -> FloatArray:
        angles = np.random.default_rng(seed).uniform(model.angle_min, model.angle_max, (count, 5, 4))
        angles[..., 3] = np.minimum(angles[..., 2] * model.coupling, model.angle_max[:, 3])
        return angles

    return legal
