"""A simulated rig without pictures, and what its services would publish."""

from __future__ import annotations

from pathlib import Path

import pytest
from stub_rig import StubRig

from rhot.rig import Rig, load_rig
from rhot.rig.template import rig_template


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    """A simulated rig with both hands and a cube, not calibrated."""
    text = rig_template(
        folder="rig", name="test", source="simulated", sides=("right", "left"), simulated_objects=("cube",), seed=1
    )
    (tmp_path / "rig.toml").write_text(text)
    return load_rig(tmp_path)


@pytest.fixture
def stub(rig: Rig) -> StubRig:
    """Makes the messages of any moment; does not run."""
    return StubRig(rig, "", predicted=("little",))
