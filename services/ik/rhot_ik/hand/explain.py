"""Explain the hand estimate: residuals, angles and their limits, the prior (read-only)."""

from __future__ import annotations

import numpy as np

from rhot.anatomy.skeleton import FINGERS
from rhot.explain import Explanation, ExplanationRow
from rhot_ik.hand.filter.prior import angle_covariance, rest_angles
from rhot_ik.hand.filter.process import ANGLES, POSITION, ROTATION
from rhot_ik.hand.solver import HandSolution, HandSolver, HandTrack

_ANGLES = ("flexion", "abduction", "middle hinge", "last hinge")
_AT_LIMIT_RAD = 1e-4
_UNUSUAL = 2.0
"""Standard deviations from rest beyond which an angle is marked."""


def solver_tables(side: str, solver: HandSolver) -> list[Explanation]:
    """Return what a solver knows of one hand after the sample it was given last."""
    track, solution = solver.track, solver.solution
    if track is None or solution is None:
        row = ExplanationRow((f"no {side} hand: its base marker and a fingertip must be seen",), "refused")
        return [Explanation(f"Hand {side}: nothing is known", ("",), (row,))]
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
                "taken" if seen else "refused",
            )
        )
    return Explanation(
        f"Hand {side}: residual of each finger",
        ("finger", "state", "marker off the model, mm", "marker"),
        tuple(rows),
    )


def _angles(side: str, solver: HandSolver, track: HandTrack) -> Explanation:
    state, model = track.state, solver.geometry.model
    rest = rest_angles(model).reshape(5, 4)
    usual = np.sqrt(np.diag(angle_covariance(model))).reshape(5, 4)
    sigma = np.sqrt(np.diag(state.P)[ANGLES]).reshape(5, 4)
    shown, filtered = track.shown, state.angles.reshape(5, 4)
    rows = []
    for place, finger in enumerate(FINGERS):
        for angle, name in enumerate(_ANGLES):
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
                    "refused" if (limit and low < high) or abs(off) > _UNUSUAL else "",
                )
            )
    return Explanation(
        f"Hand {side}: angles, limits and prior",
        (
            "finger",
            "angle",
            "shown, °",
            "filter, °",
            "sigma, °",
            "limits, °",
            "at limit",
            "at rest, °",
            "off rest, sigma",
        ),
        tuple(rows),
        "Shown is what was published: the filter's angles, with smooth transitions between sources. Marked are "
        f"angles at a limit and those more than {_UNUSUAL:g} standard deviations from a hand at rest.",
    )


def _palm(side: str, solver: HandSolver, track: HandTrack, solution: HandSolution) -> Explanation:
    state = track.state
    shift, tilt, longer = state.person[:3], state.person[3:6], state.longer
    rotation, position = np.sqrt(np.diag(state.P)[ROTATION]), np.sqrt(np.diag(state.P)[POSITION])
    rows = [
        ("wrist x, y, z, mm", ", ".join(f"{1e3 * value:.1f}" for value in state.p)),
        ("sigma of its position, mm", " / ".join(f"{1e3 * value:.1f}" for value in position)),
        ("sigma of its rotation, °", " / ".join(f"{np.degrees(value):.1f}" for value in rotation)),
        ("speed, m/s", f"{np.linalg.norm(state.velocity):.3f}"),
        ("angular velocity, °/s", f"{np.degrees(np.linalg.norm(state.angular_velocity)):.0f}"),
        ("base marker measured", "yes" if solution.palm_measured else "no"),
        ("rotation measured by the patch's corners", "yes" if track.corners_measured else "no"),
        ("seen tips miss the model by, mean, mm", f"{1e3 * state.mean_residual_m:.2f}"),
        ("patch off its place, learned, mm", " / ".join(f"{1e3 * value:.1f}" for value in shift)),
        ("patch tilted on the palm, learned, °", " / ".join(f"{np.degrees(value):.1f}" for value in tilt)),
        ("fingers longer than the model's, learned, %", " / ".join(f"{100.0 * value:.0f}" for value in longer)),
        ("solver", solver.config.solver),
    ]
    return Explanation(f"Hand {side}: the palm", ("figure", "value"), tuple(ExplanationRow(row) for row in rows))
