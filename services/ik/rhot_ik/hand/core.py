"""From `rhot/points` to `rhot/hand/<side>`: binds markers to hands and wraps solutions into messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import BoolArray
from rhot.core import Output
from rhot.explain import Explanation
from rhot.geometry.covariances import has_covariance
from rhot.messages import FingerAngles, HandPose, ObjectPose, ObjectShape, Point, PointSet, Side
from rhot.rig import IkConfig, MarkerConfig, Rig
from rhot_ik.hand.block_smoothing import BlockSmoother
from rhot_ik.hand.contact import Shape, shape_of
from rhot_ik.hand.explain import solver_tables
from rhot_ik.hand.filter.evidence import HandObservation
from rhot_ik.hand.fingers.geometry import FingerGeometry, base_marker
from rhot_ik.hand.fit_check import MISFIT_M, FitCheck, mean_residual_m, reflected_point
from rhot_ik.hand.repeated_predictions import RepeatedPredictions
from rhot_ik.hand.solver import HandSolver
from rhot_ik.hand.track import HandSolution

_ANGLES = tuple(FingerAngles.model_fields)
_REACH = 1.6
"""No fingertip is further from the back of its hand than this many hand lengths."""
_NOWHERE: tuple[float, ...] = (math.nan, math.nan, math.nan)
_ANY: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
"""Covariance, m², of a tip that is not there."""


class HandCore:
    """The core of the ik service: one solver per hand that wears a marker on its back.

    Args:
        rig: marker table, hand sizes and configuration.
    """

    def __init__(self, rig: Rig) -> None:
        self._markers: Mapping[str, MarkerConfig] = rig.config.markers
        self._solvers: dict[Side, HandSolver] = {}
        self._bases: dict[Side, str] = {}
        self._fits: dict[Side, FitCheck] = {}
        self._is_fitting: dict[Side, bool] = {}
        # Cameras whose places are only roughly known leave as much with the right hand.
        self._misfit_m = MISFIT_M if rig.calibrated else math.inf
        self._counts = {"hands": 0, "no_hand": 0, "outside": 0, "not_of_this_hand": 0, "no_covariance": 0}
        self._volume_m = rig.config.fusion.volume_m
        self._problems: list[str] = []
        self._hold_s = rig.config.ik.hold_s
        self._predictions = RepeatedPredictions()
        # Messages do not say which object they are of; two of the very same shape count as one.
        self._objects: dict[ObjectShape, tuple[int, Shape]] = {}
        places = [np.array(camera.T_rig_camera)[:3, 3] for camera in rig.cameras.values()]
        viewpoint = np.mean(places, axis=0) if places else None
        for side in rig.config.sides:
            model = HandModel.from_file(rig.hand, side)
            base = base_marker(model, self._markers)
            if base is None:
                self._problems.append(f"the {side} hand has no marker on wrist or palm in rig.toml and is not solved")
                continue
            self._bases[side] = base
            self._solvers[side] = HandSolver(model, self._markers, base, rig.config.ik, viewpoint)
            mirrored = None if viewpoint is None else reflected_point(viewpoint)
            parts = model, self._markers, base, rig.config.ik, mirrored
            self._fits[side] = FitCheck(side, partial(HandSolver, *parts))
        self._block_smoother = BlockSmoother(self._solvers)

    def configure(self, config: IkConfig) -> None:
        """Switch to another configuration from the next sample on."""
        self._hold_s = config.hold_s
        for solver in self._solvers.values():
            solver.config = config

    @property
    def figures(self) -> Mapping[str, float]:
        """None beyond the counts."""
        return {}

    @property
    def problem(self) -> str:
        """Hands that cannot be solved for want of a marker to hold the palm by, or that do not fit their markers."""
        misfits = [fit.problem for fit in self._fits.values()]
        return "; ".join([*self._problems, *(each for each in misfits if each)])

    @property
    def counts(self) -> Mapping[str, int]:
        """What became of the samples.

        `hands` solved and published; `no_hand`: too little of a hand was seen. Points left out: `outside` of where
        markers can be, `not_of_this_hand` because they are too far from its palm, or `no_covariance` because what they
        state as one is not positive.
        """
        return self._counts

    def feed(self, points: PointSet) -> list[Output]:
        """Return the `HandPose` of each hand that the points show, with its key."""
        return self._outputs(points, self._solve(points))

    def feed_smoothed(self, points: PointSet) -> list[tuple[PointSet, list[Output]]]:
        """Process points like `feed`, and return the earlier points whose smoothed hands are final, with these hands.

        Points are returned in order, each with its hands smoothed over the points before and after it; `finish`
        returns the rest.
        """
        tracks = {side: track for side in self._solve(points) if (track := self._solvers[side].track) is not None}
        return [(settled, self._outputs(settled, found)) for settled, found in self._block_smoother.add(points, tracks)]

    def finish(self) -> list[tuple[PointSet, list[Output]]]:
        """Return the points that `feed_smoothed` has not returned yet, with their hands; call it at the end."""
        return [(settled, self._outputs(settled, found)) for settled, found in self._block_smoother.finish()]

    def _outputs(self, points: PointSet, found: Mapping[Side, HandSolution]) -> list[Output]:
        """Return the messages that carry solutions, with their keys."""
        outputs: list[Output] = []
        for side, solution in found.items():
            geometry = self._solvers[side].geometry
            miss_m = mean_residual_m(solution.residual, _two_views(points, geometry))
            # With fewer than two tips to judge by, what was known last holds.
            fits = self._is_fitting.get(side, True) if miss_m is None else miss_m <= self._misfit_m
            self._is_fitting[side] = fits
            outputs.append((f"rhot/hand/{side}", hand_pose(points, geometry.model, solution, fits=fits)))
        return outputs

    def _solve(self, points: PointSet) -> dict[Side, HandSolution]:
        """Return the hands that points show."""
        found: dict[Side, HandSolution] = {}
        held_ns = round(self._hold_s * 1e9)
        shapes = [shape for t_ns, shape in self._objects.values() if abs(points.t_ns - t_ns) <= held_ns]
        for side, solver in self._solvers.items():
            seen = self._observation(points, self._bases[side], solver)
            solution = solver.solve(seen, shapes)
            if solution is None:
                self._counts["no_hand"] += 1
            else:
                self._counts["hands"] += 1
                self._fits[side].add(seen, solution.residual, _two_views(points, solver.geometry))
                found[side] = solution
        return found

    def feed_object(self, pose: ObjectPose) -> None:
        """Remember where an object is that hidden fingers may close round; one without a shape tells nothing."""
        shape = shape_of(pose)
        if shape is not None and pose.shape is not None and pose.frame == "rig":
            self._objects[pose.shape] = pose.t_ns, shape

    def explain(self) -> list[Explanation]:
        """Return what is known of each hand after the newest points, and why; see `rhot.explain`."""
        return [table for side, solver in self._solvers.items() for table in solver_tables(side, solver)]

    def _observation(self, points: PointSet, base_name: str, solver: HandSolver) -> HandObservation:
        tips, covariances, measured, certain = [_NOWHERE] * 5, [_ANY] * 5, [False] * 5, [False] * 5
        base = self._believable(points, base_name)
        reach_m = _REACH * solver.geometry.model.length_m
        for place, finger in enumerate(FINGERS):
            point = self._believable(points, solver.geometry.markers.get(finger, ""))
            if point is None:
                continue
            if base is not None and math.dist(point.position, base.position) > reach_m:
                self._counts["not_of_this_hand"] += 1
                continue
            tips[place] = point.position
            covariances[place] = self._predictions.covariance(solver.geometry.markers[finger], point)
            # Fusion calls what cameras see badly predicted, too; how badly is stated.
            certain[place] = point.state != "predicted"
            measured[place] = certain[place] or point.views > 0
        return HandObservation(
            t_ns=points.t_ns,
            base=None if base is None else np.array(base.position),
            base_measured=base is not None and base.state != "predicted",
            corners=None if base is None or base.corners is None else np.array(base.corners),
            tips=np.array(tips),
            tips_measured=np.array(measured),
            tips_certain=np.array(certain),
            base_covariance=None
            if base is None
            else np.array(self._predictions.covariance(base_name, base)).reshape(3, 3),
            tip_covariances=np.array(covariances).reshape(-1, 3, 3),
        )

    def _believable(self, points: PointSet, name: str) -> Point | None:
        """Return a point of a set if it lies where markers can be; fusion sends no others, but the bus may."""
        point = points.points.get(name)
        if point is None:
            return None
        if not has_covariance(point):
            self._counts["no_covariance"] += 1
            return None
        x, y, z = point.position
        (low_x, low_y, low_z), (high_x, high_y, high_z) = self._volume_m
        if low_x <= x <= high_x and low_y <= y <= high_y and low_z <= z <= high_z:
            return point
        self._counts["outside"] += 1
        return None


def _two_views(points: PointSet, geometry: FingerGeometry) -> BoolArray:
    """Return which fingertips (5,) two cameras see at this moment."""
    tips = [points.points.get(geometry.markers.get(finger, "")) for finger in FINGERS]
    return np.array([tip is not None and tip.state == "measured" for tip in tips])


def hand_pose(points: PointSet, model: HandModel, solution: HandSolution, *, fits: bool) -> HandPose:
    """Return the message that carries a solution; one that does not fit the points is not called measured."""
    positions = solution.positions.tolist()
    orientations = solution.orientations.tolist()
    radii = model.radii.tolist()
    angles = solution.angles.tolist()
    residual = solution.residual.tolist()
    measured = (solution.fingers_measured & fits).tolist()
    # One validation of the whole is a third faster than one of each joint.
    return HandPose.model_validate(
        {
            "t_ns": points.t_ns,
            "side": model.side,
            "frame": points.frame,
            "joints": {
                name: {"position": tuple(position), "orientation": tuple(orientation), "radius": radius}
                for name, position, orientation, radius in zip(JOINTS, positions, orientations, radii, strict=True)
            },
            "angles": {
                finger: dict(zip(_ANGLES, values, strict=True)) for finger, values in zip(FINGERS, angles, strict=True)
            },
            "residual": {f: error for f, error in zip(FINGERS, residual, strict=True) if not math.isnan(error)},
            "fingers": {f: "measured" if found else "predicted" for f, found in zip(FINGERS, measured, strict=True)},
            "state": "measured" if solution.palm_measured and any(measured) else "predicted",
        }
    )
