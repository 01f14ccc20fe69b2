"""The hand that the chains are made of."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hands.legal_angles import legal_angles

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray
from rhot.rig import HandFile


@pytest.fixture
def right_hand() -> HandModel:
    return HandModel.from_file(HandFile(), "right")


@pytest.fixture
def random_angles() -> Callable[[HandModel, int, int], FloatArray]:
    return legal_angles
