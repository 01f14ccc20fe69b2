"""From `rhot/points` to `rhot/hand/<side>`: binds markers to hands and wraps solutions into messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import CHAINS, FINGER_ANGLES, FINGERS, JOINTS
from rhot.arrays import BoolArray, FloatArray
from rhot.core import Explanation, ExplanationRow, Output
from rhot.geometry.covariances import has_covariance, stated_covariance
from rhot.geometry.distance_grid import DistanceGrid
from rhot.geometry.rotations import rigid, rotation_from_quaternion
from rhot.messages import (
    BoxShape,
    CylinderShape,
    HandPose,
    MeshShape,
    ObjectPose,
    ObjectShape,
    Point,
    PointSet,
)
from rhot.object_mesh import known_mesh
from rhot.rig import IkConfig, MarkerConfig, Rig
from rhot.types import Side
from rhot_ik.hand.closed_form import FingerGeometry, base_marker
from rhot_ik.hand.contact import Box, Cylinder, Hull, Shape, Solid, Sphere
from rhot_ik.hand.filter.evidence import HandObservation
from rhot_ik.hand.filter.process import ANGLES, POSITION, ROTATION, angle_covariance, rest_angles
from rhot_ik.hand.fit_check import MISFIT_M, FitCheck, mean_residual_m, reflected_point
from rhot_ik.hand.solver import HandSolver
from rhot_ik.hand.track import HandSolution, HandTrack

# Weights of points that are partly predicted: repeating a prediction adds little information.
#
# Where no camera, or only one, sees a marker, fusion extrapolates: a `predicted` point continues the last motion, and
# the depth of a `one_view` point follows from the rest of the hand. A single view is also biased across its ray: a
# marker that the other camera does not see is usually half hidden, and the centre of the visible half is not that of
# the marker. These errors are part of the stated covariance, but they are correlated from sample to sample. The
# filter assumes independent errors, so the k-th consecutive sample is weighted by 1/k: its covariance is multiplied
# by k. The information then grows with the logarithm of the number of samples, whatever the frame rate. A point that
# two cameras see is never treated as a prediction, whatever its state and however poor the views.


class RepeatedPredictions:
    """Counts, for each marker, the consecutive samples that are the same kind of prediction."""

    def __init__(self) -> None:
        self._running: dict[str, tuple[int, int]] = {}

    def covariance(self, name: str, point: Point) -> tuple[float, ...]:
        """Return the covariance (9,) that a marker's newest point counts with, m², row by row."""
        views = 2 if point.state == "measured" else min(point.views, 2)
        earlier, before = self._running.get(name, (views, 0))
        times = before + 1 if earlier == views else 1
        self._running[name] = views, times
        stated = stated_covariance(point.covariance, point.sigma)
        return stated if views == 2 else tuple(times * value for value in stated)


# Explain the hand estimate: residuals, angles and their limits, the prior (read-only).

_EXPLAIN_ANGLES = ("flexion", "abduction", "middle hinge", "last hinge")
_AT_LIMIT_RAD = 1e-4
_UNUSUAL = 2.0
"""Standard deviations from rest beyond which an angle is marked."""


def solver_tables(side: str, solver: HandSolver) -> list[Explanation]:
    """Return the tables of a solver's state of one hand after its last sample."""
    track, solution = solver.track, solver.solution
    if track is None or solution is None:
        row = ExplanationRow((f"no {side} hand: the base marker and a fingertip must be visible",), "rejected")
        return [Explanation(f"Hand {side}: not tracked", ("",), (row,))]
    return [_fingers(side, solver, solution), _angles(side, solver, track), _palm(side, solver, track, solution)]


def _fingers(side: str, solver: HandSolver, solution: HandSolution) -> Explanation:
    rows = []
    for place, finger in enumerate(FINGERS):
        miss = float(solution.residual[place])
        seen = bool(solution.fingers_measured[place])
        rows.append(
            ExplanationRow(
                (
                    finger,
                    "measured" if seen else "predicted",
                    "" if np.isnan(miss) else f"{1e3 * miss:.2f}",
                    solver.geometry.markers.get(finger, "none"),
                ),
                "accepted" if seen else "rejected",
            )
        )
    return Explanation(
        f"Hand {side}: residual of each finger",
        ("finger", "state", "residual, mm", "marker"),
        tuple(rows),
    )


def _angles(side: str, solver: HandSolver, track: HandTrack) -> Explanation:
    state, model = track.state, solver.geometry.model
    rest = rest_angles(model).reshape(5, 4)
    usual = np.sqrt(np.diag(angle_covariance(model))).reshape(5, 4)
    sigma = np.sqrt(np.diag(state.P)[ANGLES]).reshape(5, 4)
    shown, filtered = track.angles, state.angles.reshape(5, 4)
    rows = []
    for place, finger in enumerate(FINGERS):
        for angle, name in enumerate(_EXPLAIN_ANGLES):
            low, high = model.angle_min[place, angle], model.angle_max[place, angle]
            value, at = filtered[place, angle], (place, angle)
            limit = "lower" if value - low < _AT_LIMIT_RAD else "upper" if high - value < _AT_LIMIT_RAD else ""
            off = (value - rest[at]) / max(usual[at], 1e-9)
            rows.append(
                ExplanationRow(
                    (
                        finger,
                        name,
                        f"{np.degrees(shown[at]):.1f}",
                        f"{np.degrees(value):.1f}",
                        f"{np.degrees(sigma[at]):.1f}",
                        f"{np.degrees(low):.0f} to {np.degrees(high):.0f}",
                        limit,
                        f"{np.degrees(rest[at]):.0f} ± {np.degrees(usual[at]):.0f}",
                        f"{off:+.1f}",
                    ),
                    "rejected" if (limit and low < high) or abs(off) > _UNUSUAL else "",
                )
            )
    return Explanation(
        f"Hand {side}: angles, limits and prior",
        (
            "finger",
            "angle",
            "published, °",
            "filter, °",
            "sigma, °",
            "limits, °",
            "at limit",
            "prior, °",
            "from prior, sigma",
        ),
        tuple(rows),
        f"Red: angles at a limit, or more than {_UNUSUAL:g} standard deviations from the prior, a hand at rest.",
    )


def _palm(side: str, solver: HandSolver, track: HandTrack, solution: HandSolution) -> Explanation:
    state = track.state
    shift, tilt, longer = state.person[:3], state.person[3:6], state.longer
    rotation, position = np.sqrt(np.diag(state.P)[ROTATION]), np.sqrt(np.diag(state.P)[POSITION])
    rows = [
        ("wrist x, y, z, mm", ", ".join(f"{1e3 * value:.1f}" for value in state.p)),
        ("sigma of the position, mm", " / ".join(f"{1e3 * value:.1f}" for value in position)),
        ("sigma of the rotation, °", " / ".join(f"{np.degrees(value):.1f}" for value in rotation)),
        ("speed, m/s", f"{np.linalg.norm(state.velocity):.3f}"),
        ("angular velocity, °/s", f"{np.degrees(np.linalg.norm(state.angular_velocity)):.0f}"),
        ("base marker measured", "yes" if solution.palm_measured else "no"),
        ("rotation measured by the patch's corners", "yes" if track.corners_measured else "no"),
        ("mean residual of visible fingertips, mm", f"{1e3 * state.mean_residual_m:.2f}"),
        ("estimated offset of the patch, mm", " / ".join(f"{1e3 * value:.1f}" for value in shift)),
        ("estimated tilt of the patch, °", " / ".join(f"{np.degrees(value):.1f}" for value in tilt)),
        ("estimated excess length of the fingers, %", " / ".join(f"{100.0 * value:.0f}" for value in longer)),
        ("solver", solver.config.solver),
    ]
    return Explanation(f"Hand {side}: palm", ("quantity", "value"), tuple(ExplanationRow(row) for row in rows))


# Smoothing of a recording in blocks, so that memory does not grow with its length.

Settled = list[tuple[PointSet, dict[Side, HandSolution]]]

AHEAD_NS: Final = 5_000_000_000
"""A sample says next to nothing of a hand so long before: angles keep for 2 s."""
PIECE_NS: Final = 5_000_000_000
"""So much is smoothed at once; with what is ahead of it, 10 s of tracks are kept, some 40 MB at 120 points a second."""


class BlockSmoother:
    """Keeps the newest samples of all hands, and gives them back with what later ones said of them.

    Args:
        solvers: those that made the tracks.
        ahead_ns: a sample is settled when those of so long after it are known.
        piece_ns: so much is smoothed at once.
    """

    def __init__(
        self, solvers: Mapping[Side, HandSolver], *, ahead_ns: int = AHEAD_NS, piece_ns: int = PIECE_NS
    ) -> None:
        self._solvers = solvers
        self._ahead_ns, self._piece_ns = ahead_ns, piece_ns
        self._kept: list[tuple[PointSet, Mapping[Side, HandTrack]]] = []

    def add(self, points: PointSet, tracks: Mapping[Side, HandTrack]) -> Settled:
        """Take one sample with what each hand's solver made of it, and return those that are settled by now."""
        self._kept.append((points, tracks))
        if points.t_ns - self._kept[0][0].t_ns < self._ahead_ns + self._piece_ns:
            return []
        return self._settled(points.t_ns - self._ahead_ns)

    def finish(self) -> Settled:
        """Return all that is left; nothing comes after it."""
        return self._settled(self._kept[-1][0].t_ns) if self._kept else []

    def _settled(self, until_ns: int) -> Settled:
        solutions: list[dict[Side, HandSolution]] = [{} for _ in self._kept]
        for side, solver in self._solvers.items():
            places = [place for place, (_, tracks) in enumerate(self._kept) if side in tracks]
            smoothed = solver.smoothed([self._kept[place][1][side] for place in places])
            for place, solution in zip(places, smoothed, strict=True):
                solutions[place][side] = solution
        ready = sum(points.t_ns <= until_ns for points, _ in self._kept)
        settled = [(points, found) for (points, _), found in zip(self._kept[:ready], solutions, strict=False)]
        del self._kept[:ready]
        return settled


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
        meshes = [mesh for name in rig.config.objects if (mesh := known_mesh(rig, name)) is not None]
        self._grids = {mesh.shape: mesh.distances for mesh in meshes}
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
            outputs.append((f"rhot/hand/{side}", hand_pose(points, geometry, solution, fits=fits)))
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
        if pose.shape is not None and pose.frame == "rig":
            T = rigid(rotation_from_quaternion(np.array(pose.orientation)), np.array(pose.position))
            self._objects[pose.shape] = pose.t_ns, body_of(pose.shape, T, self._grids)

    def explain(self) -> list[Explanation]:
        """Return what is known of each hand after the newest points, and why; see `rhot.core`."""
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
        if not has_covariance(point.covariance, point.sigma):
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
    return np.array([state == "measured" for state in _tip_states(points, geometry)])


def _tip_states(points: PointSet, geometry: FingerGeometry) -> list[str]:
    """Return how fusion knows each of the five tips; empty = not at all."""
    tips = [points.points.get(geometry.markers.get(finger, "")) for finger in FINGERS]
    return ["" if tip is None else tip.state for tip in tips]


_TRUST: Final = {"measured": 1.0, "one_view": 1.2, "predicted": 1.5, "": 1.0}
"""What a finger's standard deviations are multiplied by, by how fusion knows its tip; empty = not at all.

68 % of the tips within one sigma would take 1.03, 1.43, 1.72 and 1.22 where recorded motion is played before simulated
rigs (develop seeds 0 to 5), and 0.56, 0.91, 1.28 and 0.48 in photo-real pictures, whose hand and paint are like the
model. The filter's own covariance counts, therefore, but for what only one view or fusion's bridge tells of.
"""
_OF_FINGER: Final = np.array([next((i for i, f in enumerate(FINGERS) if name in CHAINS[f][1:]), 5) for name in JOINTS])
"""(26,) finger that moves a joint; 5 = the palm."""


def hand_pose(points: PointSet, geometry: FingerGeometry, solution: HandSolution, *, fits: bool) -> HandPose:
    """Return the message that carries a solution; one that does not fit the points is not called measured."""
    model = geometry.model
    positions = solution.positions.tolist()
    orientations = solution.orientations.tolist()
    radii = model.radii.tolist()
    angles = solution.angles.tolist()
    residual = solution.residual.tolist()
    measured = (solution.fingers_measured & fits).tolist()
    trust = np.array([*(_TRUST[state] for state in _tip_states(points, geometry)), 1.0])
    # A metre says that nothing is known, and stays inside what a message may hold.
    sigma = np.minimum(trust[_OF_FINGER] * solution.sigma, 1.0).tolist()
    angle_sigma = (trust[:5, None] * solution.angle_sigma).tolist()
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
                finger: dict(zip(FINGER_ANGLES, values, strict=True))
                for finger, values in zip(FINGERS, angles, strict=True)
            },
            "residual": {f: error for f, error in zip(FINGERS, residual, strict=True) if not math.isnan(error)},
            "fingers": {f: "measured" if found else "predicted" for f, found in zip(FINGERS, measured, strict=True)},
            "sigma": dict(zip(JOINTS, sigma, strict=True)),
            "angle_sigma": {
                finger: dict(zip(FINGER_ANGLES, values, strict=True))
                for finger, values in zip(FINGERS, angle_sigma, strict=True)
            },
            "state": "measured" if solution.palm_measured and any(measured) else "predicted",
        }
    )


def body_of(
    shape: ObjectShape, T_rig_object: FloatArray, grids: Mapping[MeshShape, DistanceGrid] | None = None
) -> Shape:
    """Return the body of a shape whose middle stands at a pose (4, 4).

    Args:
        shape: of an object.
        T_rig_object: its pose.
        grids: of the meshes whose files are known; others are met at their hull.
    """
    if isinstance(shape, BoxShape):
        return Box(T_rig_object, np.array(shape.size))
    if isinstance(shape, CylinderShape):
        return Cylinder(T_rig_object, shape.radius, shape.height)
    if isinstance(shape, MeshShape):
        grid = (grids or {}).get(shape)
        return Hull(T_rig_object, np.array(shape.planes)) if grid is None else Solid(T_rig_object, grid)
    return Sphere(T_rig_object[:3, 3], shape.radius)
