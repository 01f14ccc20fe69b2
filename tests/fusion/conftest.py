from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import marker_streams
import pytest

from rhot.rig import Rig


@pytest.fixture
def make_rig(tmp_path: Path) -> Callable[..., Rig]:
    """A maker of rigs in a folder of this test's own."""
    return partial(marker_streams.make_rig, tmp_path)


@pytest.fixture
def thesis_rig(shared_data: Path) -> Path:
    """The real rig of 2018."""
    return shared_data / "thesis_rig"
