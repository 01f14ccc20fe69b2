"""Offline smoothing: the path of each marker, estimated from a whole recording.

The views that the live filter accepted are filtered again, now with the estimated noise of the cameras and with noise
scales of `motion` from the forward-backward algorithm (L. R. Rabiner, "A tutorial on hidden Markov models", 1989,
section III). The states are then smoothed (`backward`).

The paint corrections are then recomputed from the smoothed positions, because the live estimate of a fast hand with
slow cameras is often wrong. Views far from the smoothed path are down-weighted, markers are initialised from earlier
views that agree with the path, and the smoother runs once more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot_fusion.filter.initialisation import InitialState
from rhot_fusion.filter.joint import SCALES, SHARES, SWITCH_S, JointFilter, squared_distance
from rhot_fusion.filter.state import ROUND, SHARED, FilterStep, State, Views
from rhot_fusion.filter.tracks import GATE, LOOSE_M, PAIR_S, RAY_SIGMA_M, SPEED_SIGMA, TrackSettings

_BRIDGE_S: Final = 0.25
"""Longest time between, seconds."""
_BRIDGE_SCALE: Final = 5.0
"""Noise intensity of its motion between, m/s^1.5; a fast hand, see `SCALES`."""

# The backward pass of smoothing.
#
# Rauch, Tung and Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal 3(8), 1965:
#
#     G = P F' P⁻¹(next, before),    x ← x + G (x(next) − x(next, before)),    P ← P + G (P(next) − P(next, before)) G'.
#
# A marker that was lost is initialised anew when it comes back. Each of its lives is smoothed by itself, and the last
# state of the earlier one is then led to the beginning of the later one (`bridged`), so that what lies between is
# interpolated.


def backward(steps: Sequence[tuple[FilterStep, BoolArray]]) -> list[State]:
    """Return the smoothed states of the steps."""
    states = [step.after for step, _ in steps]
    # The newest markers' states where they were initialised, by marker; `bridged` connects earlier ones with them.
    starts: dict[int, State] = {}
    for number in range(len(steps) - 2, -1, -1):
        following, new = steps[number + 1]
        later = states[number + 1]
        starts |= dict.fromkeys(np.flatnonzero(new & later.alive).tolist(), later)
        smoothed = _smoothed(steps[number][0].after, following, later, new)
        for marker in [one for one in starts if smoothed.alive[one]]:
            smoothed = bridged(smoothed, marker, starts.pop(marker))
        states[number] = smoothed
    return states


def _smoothed(own: State, following: FilterStep, later: State, new: BoolArray) -> State:
    """Return a state smoothed by a later one, except for markers (M,) that start anew there."""
    both = own.alive & following.before.alive & later.alive & ~new
    if not both.any():
        return own
    rows, every, kept = _rows(both), _rows(own.alive), _rows(own.alive & ~new)
    before = following.before.P[np.ix_(rows, rows)]
    # Regularisation that keeps covariances of new markers invertible, m² and m²/s².
    before[np.diag_indices(len(rows))] += 1e-13
    # The shared rotation makes the other markers depend on one that starts anew, but not on where it was before.
    moved = following.transition[np.ix_(rows, kept)] @ own.P[np.ix_(kept, every)]
    gain = np.linalg.solve(before, moved).T
    x, P = own.x.copy(), own.P.copy()
    x[every] += gain @ (later.x - following.before.x)[rows]
    P[np.ix_(every, every)] += gain @ (later.P[np.ix_(rows, rows)] - before) @ gain.T
    return State(own.t_s, x, P, own.weight, own.alive)


def bridged(state: State, marker: int, start: State) -> State:
    """Return a state with a marker led to where it was initialised anew soon after.

    What followed its initialisation knows nothing of what preceded it, and is used as one observation of it. Where that
    lies beyond the gate, the marker has moved more than was assumed, and its covariance is inflated in proportion.

    Args:
        state: before; smoothed by what other markers did later.
        marker: index among the hand's markers.
        start: smoothed state at the marker's next initialisation.
    """
    dt = start.t_s - state.t_s
    # One that was initialised on a ray takes its depth from the hand, like the earlier life: that is no observation.
    if not 0.0 < dt <= _BRIDGE_S or start.spread_m2[marker] > LOOSE_M**2:
        return state
    rows = own_rows(marker, len(state.alive))
    F = constant_velocity(dt)
    noise = _BRIDGE_SCALE**2 * np.kron(np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]), np.eye(3))
    off, other = start.x[rows] - F @ state.x[rows], start.P[np.ix_(rows, rows)] + noise
    across = state.P[:, rows] @ F.T
    inverse = np.linalg.inv(F @ across[rows] + other)
    gain = across @ inverse
    P = state.P - gain @ across.T
    wider = np.ones(len(P))
    # Squared Mahalanobis distance (6 degrees of freedom) beyond which the marker's covariance is inflated;
    # exceeded by chance once in 1000.
    wider[rows] = math.sqrt(max(float(off @ inverse @ off) / 22.5, 1.0))
    P = wider[:, None] * P * wider
    return State(state.t_s, state.x + gain @ off, 0.5 * (P + P.T), state.weight, state.alive)


def constant_velocity(dt: float) -> FloatArray:
    """Return the transition (6, 6) of a marker's position and velocity over a time, seconds; it may be negative."""
    return np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(3))


def own_rows(marker: int, count: int) -> IndexArray:
    """Return the state rows (6,) of one of `count` markers."""
    three = np.arange(3 * marker, 3 * marker + 3)
    return np.concatenate([three, 3 * count + three])


def _rows(alive: BoolArray) -> IndexArray:
    """Return the state rows of the markers that are alive (M,) and of the shared accelerations."""
    return np.flatnonzero(np.concatenate([np.tile(np.repeat(alive, 3), 2), np.ones(SHARED, dtype=bool)]))


_DOUBT = 4.0
"""Squared Mahalanobis distance from the smoothed path beyond which a view's variance is inflated in proportion."""


@dataclass(slots=True)
class Event:
    """Initialisation or removal of a marker.

    Attributes:
        t_s: time, seconds.
        marker: index among the hand's markers.
        initial: initial state; None = removal.
        first: frame of the first view that it is based on; None = the frame that the event follows. Smoothing may find
            an earlier one.
        continues: whether the marker was tracked and can have moved to the new position.
    """

    t_s: float
    marker: int
    initial: InitialState | None
    first: RecordedFrame | None = None
    continues: bool = False


@dataclass(slots=True)
class RecordedFrame:
    """One frame's views of a hand's markers.

    Attributes:
        t_s: time, seconds.
        camera: index of the camera.
        views: of all markers, alive or not, with paint corrections.
        taken: (N,) which of them updated or initialised their markers live.
        events: that followed it.
        seen_xy: (N, 2) uncorrected coordinates, normalised units.
        area_px: (N,) visible areas, square pixels; 0 = unknown.
        border: (N, 3) distance to the image border as in `Sightings`.
        skin: (N, 2) where skin adjoins the markers as in `Sightings`.
        hidden_m2: (M,) variance, each axis, of the hand's markers for paint hidden from all cameras, square metres;
            None until it is computed.
    """

    t_s: float
    camera: int
    views: Views
    taken: BoolArray
    events: list[Event]
    seen_xy: FloatArray
    area_px: FloatArray
    border: FloatArray | None = None
    skin: FloatArray | None = None
    hidden_m2: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Node:
    """Smoothed markers (M) of a hand at one frame.

    Attributes:
        t_s: time, seconds.
        position: (M, 3) metres; NaN = unknown.
        velocity: (M, 3) metres per second.
        covariance: (M, 6, 6) of position and velocity.
        hidden_m2: (M,) variance, each axis, for paint hidden from all cameras, square metres.
        shown: (M,) whether the frame has a view of it that agrees with the smoothed position.
        camera: index of the frame's camera.
    """

    t_s: float
    position: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    hidden_m2: FloatArray
    shown: BoolArray
    camera: int


Correct = Callable[[Sequence[RecordedFrame], Sequence[State]], list[Views]]
"""Returns the corrected views of frames, given the smoothed states."""


def smooth(
    frames: Sequence[RecordedFrame],
    count: int,
    settings: TrackSettings,
    correct: Correct,
) -> list[Node]:
    """Return the smoothed nodes of a hand at each of the frames.

    Args:
        frames: in order of time; their views are replaced.
        count: number of the hand's markers.
        settings: of the tracks.
        correct: recomputes the paint corrections once the markers' path is known.
    """
    variance = [frame.views.variance for frame in frames]
    steps, evidence = _forward(frames, count, settings, variance, [None] * len(frames))
    scale2 = _scales(evidence, [step.dt_s for step, _ in steps])
    states = backward(_forward(frames, count, settings, variance, scale2)[0])
    _extend(frames, states)
    passes = 2
    for _ in range(1, passes):
        for frame, views in zip(frames, correct(frames, states), strict=True):
            frame.views = views
        variance = [
            frame.views.variance * np.maximum(1.0, _off_path2(frame.views, state) / _DOUBT)[:, None]
            for frame, state in zip(frames, states, strict=True)
        ]
        states = backward(_forward(frames, count, settings, variance, scale2)[0])
    return [_node(frame, state) for frame, state in zip(frames, states, strict=True)]


def _forward(
    frames: Sequence[RecordedFrame],
    count: int,
    settings: TrackSettings,
    variance: list[FloatArray],
    scale2: list[float | None],
) -> tuple[list[tuple[FilterStep, BoolArray]], list[FloatArray]]:
    # Views that the live filter rejected stay out; outliers among the rest are down-weighted instead of gated.
    hand = JointFilter(count, GATE, refuses=False)
    steps, evidence, loose_m2 = [], [], LOOSE_M**2
    begins, replaced = _begins(frames)
    for number, (frame, own, scale) in enumerate(zip(frames, variance, scale2, strict=True)):
        new = np.zeros(count, dtype=bool)
        for event in begins.get(number, ()):
            k = event.marker
            # Like live: depth that is nearly unknown is not linear in the views. Their innovations would be taken for
            # accelerations of the whole hand, and the paths of all its markers would diverge.
            if not (event.continues and hand.state.alive[k] and hand.state.spread_m2[k] <= loose_m2):
                _begin(hand, event, frame.t_s)
                new[k] = True
        alive = hand.state.alive[frame.views.index] & frame.taken
        # Markers with a large covariance are not inflated further: an outlier would make the path diverge.
        certain = np.where(hand.state.spread_m2[frame.views.index] <= loose_m2, settings.inflation_gate, np.inf)
        views = replace(frame.views, variance=own, certain=certain)
        if not alive.all():
            views = views.chosen(alive)
        innovation, step = hand.step(frame.t_s, views, scale)
        for event in frame.events:
            if event.initial is None and id(event) not in replaced:
                hand.end(event.marker)
        steps.append((FilterStep(step.dt_s, step.transition, step.before, hand.state), new))
        evidence.append(innovation.evidence)
    return steps, evidence


def _begins(frames: Sequence[RecordedFrame]) -> tuple[dict[int, list[Event]], set[int]]:
    """Return, by frame number, the initialisations that are based on its views, and which removals no longer count.

    A marker that was removed between its first new view and its initialisation is only replaced earlier.
    """
    places = {id(frame): number for number, frame in enumerate(frames)}
    begins: dict[int, list[Event]] = {}
    removed: dict[int, list[tuple[int, Event]]] = {}
    replaced: set[int] = set()
    for number, frame in enumerate(frames):
        for event in frame.events:
            if event.initial is None:
                removed.setdefault(event.marker, []).append((number, event))
                continue
            first = number if event.first is None else min(places[id(event.first)], number)
            begins.setdefault(first, []).append(event)
            replaced |= {id(removal) for when, removal in removed.get(event.marker, []) if when >= first}
    return begins, replaced


def _begin(hand: JointFilter, event: Event, t_s: float) -> None:
    """Add a marker before the views that initialised it, with a wide covariance about their position."""
    assert event.initial is not None
    then_s = hand.state.t_s if hand.state.alive.any() else t_s
    mean, covariance = event.initial.mean.copy(), event.initial.covariance.copy()
    mean[:3] += (then_s - event.t_s) * mean[3:]
    covariance[:3, :3] += RAY_SIGMA_M**2 * np.eye(3)
    covariance[3:, 3:] += SPEED_SIGMA**2 * np.eye(3)
    hand.begin(event.marker, mean, covariance, then_s)


def _scales(evidence: list[FloatArray], dt_s: list[float]) -> list[float | None]:
    """Return the squared acceleration scale of each step, estimated from all frames."""
    shares, scales2 = np.array(SHARES), np.square(SCALES)
    likelihood = [np.exp(one - one.max()) for one in evidence]
    stay = np.exp(-np.array(dt_s) / SWITCH_S)
    ahead, weight = [], shares
    for keep, one in zip(stay, likelihood, strict=True):
        weight = (keep * weight + (1.0 - keep) * shares) * one
        weight = weight / weight.sum()
        ahead.append(weight)
    behind, result = np.ones(len(shares)), []
    for number in range(len(evidence) - 1, -1, -1):
        both = ahead[number] * behind
        result.append(float(both @ scales2 / both.sum()))
        seen = likelihood[number] * behind
        behind = stay[number] * seen + (1.0 - stay[number]) * float(shares @ seen)
        behind = behind / behind.max()
    return list(reversed(result))


def _off_path2(views: Views, state: State) -> FloatArray:
    """Return the squared Mahalanobis distances (N,) of views from a smoothed path; 0 where the marker is not alive."""
    xy, _ = _seen(views, *state.mean.reshape(2, len(state.alive), 3))
    return np.where(state.alive[views.index], squared_distance(views.variance, views.xy - xy), 0.0)


def _seen(views: Views, position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the predicted views (N, 2) of positions and velocities (M, 3), and their Jacobians (N, 2, 3)."""
    R = views.camera.R_camera_rig
    there = position[views.index] + views.delta_s[:, None] * velocity[views.index]
    local = there @ R.T + views.camera.t_camera_rig
    depth = np.maximum(local[:, 2:], 0.05)
    xy = local[:, :2] / depth
    return xy, (R[:2] - xy[:, :, None] * R[2]) / depth[:, :, None]


def _on_path(frame: RecordedFrame, position: FloatArray, velocity: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distances (N,) of a frame's views from the smoothed path.

    As in the gate of the live filter, the variance includes the slack for occlusion and the covariance (M, 3, 3) of the
    path itself.
    """
    views = frame.views
    xy, J = _seen(views, position, velocity)
    S = J @ covariance[views.index] @ np.swapaxes(J, 1, 2)
    variance = views.variance + (views.slack * views.slack)[:, None] * ROUND + S.reshape(-1, 4)[:, (0, 1, 3)]
    # The paint correction may be too large, so the uncorrected coordinates are accepted as well.
    return np.minimum(squared_distance(variance, views.xy - xy), squared_distance(variance, frame.seen_xy - xy))


def _node(frame: RecordedFrame, state: State) -> Node:
    count = len(state.alive)
    position, velocity = state.mean.reshape(2, count, 3).copy()
    diagonal = np.arange(count)
    P = state.covariance.reshape(2, count, 3, 2, count, 3)[:, diagonal, :, :, diagonal].reshape(count, 6, 6)
    shown, index = np.zeros(count, dtype=bool), frame.views.index
    shown[index] = state.alive[index] & (_on_path(frame, position, velocity, P[:, :3, :3]) <= GATE)
    position[~state.alive] = np.nan
    hidden_m2 = np.zeros(count) if frame.hidden_m2 is None else frame.hidden_m2
    return Node(state.t_s, position, velocity, P, hidden_m2, shown, frame.camera)


def _extend(frames: Sequence[RecordedFrame], states: Sequence[State]) -> None:
    """Move the initialisation of markers to earlier views that agree with the smoothed path extrapolated backwards."""
    for number, starts in _begins(frames)[0].items():
        for start in [start for start in starts if not start.continues and states[number].alive[start.marker]]:
            marker, first = start.marker, states[number]
            position, velocity = first.mean.reshape(2, -1, 3).copy()
            rows = own_rows(marker, len(first.alive))
            own, covariance = first.P[np.ix_(rows, rows)], np.zeros((len(first.alive), 3, 3))
            for earlier in reversed(frames[:number]):
                mine = earlier.views.index == marker
                dt = earlier.t_s - first.t_s
                if dt < -PAIR_S or earlier.taken[mine].any():
                    break
                F = constant_velocity(dt)
                position[marker] = first.mean[0].reshape(-1, 3)[marker] + dt * velocity[marker]
                covariance[marker] = (F @ own @ F.T)[:3, :3]
                if (_on_path(earlier, position, velocity, covariance)[mine] <= GATE).any():
                    earlier.taken |= mine
                    start.first = earlier
