"""The ik service: points in, hands out; head and feet in, and with the hands the body out."""

from __future__ import annotations

from rhot.messages import FootPose, HeadPose, ObjectPose, PointSet
from rhot.rig import IkConfig, Rig
from rhot.rig.folder import latest_rig
from rhot.service import StageService
from rhot_ik.stage import IkStage


def ik_service(rig: Rig) -> StageService[PointSet | ObjectPose | HeadPose | FootPose, IkConfig]:
    """Return the service that turns `rhot/points` into `rhot/hand/<side>`, and head and feet into `rhot/body`."""

    def make_stage(config: IkConfig) -> IkStage:
        stage = IkStage(latest_rig(rig))
        stage.configure(config)
        return stage

    side_inputs: dict[str, type[PointSet | ObjectPose | HeadPose | FootPose]] = {"rhot/object/*": ObjectPose}
    if rig.config.feet:
        side_inputs |= {"rhot/head": HeadPose, "rhot/foot/*": FootPose}
    return StageService[PointSet | ObjectPose | HeadPose | FootPose, IkConfig](
        "ik",
        input_keys="rhot/points",
        model=PointSet,
        key_of=None,
        config=rig.config.ik,
        make_stage=make_stage,
        side_inputs=side_inputs,
    )
