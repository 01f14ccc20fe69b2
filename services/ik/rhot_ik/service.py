"""The ik service: points in, hands out; head and feet in, and with the hands the body out."""

from __future__ import annotations

from rhot.messages import FootPose, HeadPose, ObjectPose, PointSet
from rhot.rig import IkConfig, Rig
from rhot.rig.folder import latest_rig
from rhot.service import CoreService
from rhot_ik.core import IkCore


def ik_service(rig: Rig) -> CoreService[PointSet | ObjectPose | HeadPose | FootPose, IkConfig]:
    """Return the service that turns `rhot/points` into `rhot/hand/<side>`, and head and feet into `rhot/body`."""

    def make_core(config: IkConfig) -> IkCore:
        core = IkCore(latest_rig(rig))
        core.configure(config)
        return core

    side_inputs: dict[str, type[PointSet | ObjectPose | HeadPose | FootPose]] = {"rhot/object/*": ObjectPose}
    if rig.config.feet:
        side_inputs |= {"rhot/head": HeadPose, "rhot/foot/*": FootPose}
    return CoreService[PointSet | ObjectPose | HeadPose | FootPose, IkConfig](
        "ik",
        input_keys="rhot/points",
        model=PointSet,
        key_of=None,
        config=rig.config.ik,
        make_core=make_core,
        side_inputs=side_inputs,
    )
