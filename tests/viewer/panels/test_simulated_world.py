"""The choice of what a simulated rig's cameras see."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import pytest

from rhot.rig.config import SimConfig
from rhot_viewer.panels.calibrate import SimulatedWorld


@pytest.mark.parametrize("motion", get_args(SimConfig.model_fields["motion"].annotation))
def test_every_motion_of_a_rig_can_be_shown(motion: Any, tmp_path: Path) -> None:
    shown: dict[str, Any] = {}

    def add_dropdown(label: str, options: tuple[str, ...], **settings: Any) -> SimpleNamespace:
        shown.update(settings, options=options)
        return SimpleNamespace(on_update=lambda _: None)

    config: Any = SimpleNamespace(sim=SimConfig(motion=motion), cameras={})
    page: Any = SimpleNamespace(on_loop=lambda work: work)
    gui: Any = SimpleNamespace(add_dropdown=add_dropdown)
    SimulatedWorld(tmp_path, config).build(gui, page, lambda _: None)
    assert shown["initial_value"] in shown["options"]
