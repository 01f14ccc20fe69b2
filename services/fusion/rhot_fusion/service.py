"""The fusion service: computes points from marker frames and owns the rig clock.

It also publishes the other coordinate frames that the rig folder defines, such as the floor's.
"""

from __future__ import annotations

from rhot.messages import MarkerFrame
from rhot.rig import FusionConfig, Rig
from rhot.rig.folder import latest_rig
from rhot.service import CoreService, Node
from rhot.service.configuration import serve_rig_files
from rhot.service.spaces import publish_spaces
from rhot_fusion.core import FusionCore


class _FusionService(CoreService[MarkerFrame, FusionConfig]):
    def __init__(self, rig: Rig) -> None:
        def make_core(config: FusionConfig) -> FusionCore:
            core = FusionCore(latest_rig(rig))
            core.configure(config)
            return core

        super().__init__(
            "fusion",
            input_keys="rhot/markers/*",
            model=MarkerFrame,
            key_of=lambda frame: f"rhot/markers/{frame.camera}",
            config=rig.config.fusion,
            make_core=make_core,
            owns_clock=True,
        )
        self._rig_path = rig.path

    def attach(self, node: Node) -> None:
        super().attach(node)
        publish_spaces(node, self._rig_path)
        serve_rig_files(node.bus, self._rig_path)


def fusion_service(rig: Rig) -> CoreService[MarkerFrame, FusionConfig]:
    """Return the service that computes `rhot/points` from `rhot/markers/*`."""
    return _FusionService(rig)
