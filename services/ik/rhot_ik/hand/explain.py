"""Explain the hand estimate: residuals, angles and their limits, the prior (read-only)."""

from __future__ import annotations

import numpy as np

from rhot.anatomy.skeleton import FINGERS
from rhot.explain import Explanation, ExplanationRow
from rhot_ik.hand.filter.prior import angle_covariance, rest_angles
from rhot_ik.hand.filter.process import ANGLES, POSITION, ROTATION
from rhot_ik.hand.solver import HandSolver
from rhot_ik.hand.track import HandSolution, HandTrack

_ANGLES = ("flexion", "abduction", "middle hinge", "last hinge")
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
        "Published: the filter's angle, blended when a finger reappears. Red: angles at a limit, or more than "
        f"{_UNUSUAL:g} standard deviations from the prior, a hand at rest.",
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
