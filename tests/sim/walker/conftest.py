"""People and worlds for the tests of the walking person."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from rhot.anatomy.body_proportions import BodyModel
from rhot.rig import BodyConfig
from rhot_sim.walker.person import Person


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def body() -> BodyModel:
    return BodyModel.from_config(BodyConfig(height_m=1.75))


@pytest.fixture(scope="session")
def person() -> Callable[[str, int, float], Person]:
    """Give a function (program, seed, height) -> person with a camera pitched as on the thesis's headset."""

    def of(program: str, seed: int = 1, height_m: float = 1.75) -> Person:
        body = BodyModel.from_config(BodyConfig(height_m=height_m))
        return Person(seed, body, program, np.radians(20.0))

    return of
