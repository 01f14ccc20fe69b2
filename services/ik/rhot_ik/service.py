"""The ik service: points in, hands out."""

from __future__ import annotations

from rhot.messages import PointSet
from rhot.rig import IkConfig, Rig
from rhot.service import StageService
from rhot_ik.stage import HandStage


def ik_service(rig: Rig) -> StageService[PointSet, IkConfig]:
    """Return the service that turns `rhot/points` into `rhot/hand/<side>`."""

    def make_stage(config: IkConfig) -> HandStage:
        stage = HandStage(rig)
        stage.configure(config)
        return stage

    return StageService(
        "ik",
        input_keys="rhot/points",
        model=PointSet,
        key_of=None,
        config=rig.config.ik,
        make_stage=make_stage,
    )
