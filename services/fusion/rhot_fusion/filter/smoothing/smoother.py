"""Offline smoothing: the path of each marker, estimated from a whole recording.

The views that the live filter accepted are filtered again, now with the estimated noise of the cameras and with noise
scales of `motion` from the forward-backward algorithm (L. R. Rabiner, "A tutorial on hidden Markov models", 1989,
section III). The states are then smoothed (Rauch, Tung and Striebel, "Maximum likelihood estimates of linear dynamic
systems", AIAA Journal 3(8), 1965):

    G = P F' P⁻¹(next, before),    x ← x + G (x(next) − x(next, before)),    P ← P + G (P(next) − P(next, before)) G'.

The paint corrections are then recomputed from the smoothed positions, because the live estimate of a fast hand with
slow cameras is often wrong. Views far from the smoothed path are down-weighted, and the smoother runs once more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot_fusion.filter.initialisation import InitialState
from rhot_fusion.filter.joint import JointFilter, squared_distance
from rhot_fusion.filter.settings import FilterSettings
from rhot_fusion.filter.state import ROUND, SHARED, State, Step, Views

_JITTER: float = 1e-13
"""Keeps covariances of markers that were just found invertible, m² and m²/s²."""
_DOUBT = 4.0
"""Squared Mahalanobis distance of a view from the smoothed path beyond which its variance grows in proportion."""
_PASSES = 2


@dataclass(frozen=True, slots=True)
class Event:
    """A marker that begins or ends.

    Attributes:
        t_s: when.
        marker: of the hand.
        initial: its first state; none when it ends.
        first: frame of the first view behind it; none = the one that it followed.
        goes_on: whether it was known before and may well have moved to where it begins.
    """

    t_s: float
    marker: int
    initial: InitialState | None
    first: Frame | None = None
    goes_on: bool = False


@dataclass(slots=True)
class Frame:
    """One frame's views of a hand's markers.

    Attributes:
        t_s: its moment.
        camera: index of the camera.
        views: of markers, whether alive or not, corrected for what is seen of their paint.
        taken: (N,) which of them moved or began their markers live.
        events: that followed it.
        seen_xy: (N, 2) where the camera saw them, normalised units.
        area_px: (N,) of each, square pixels; 0 = not told.
        border: (N, 3) of the picture, as `Sightings` has it.
        hidden_m2: (M,) variance of the hand's markers for paint that no camera shows, each axis, square metres; none
            before it is known.
    """

    t_s: float
    camera: int
    views: Views
    taken: BoolArray
    events: list[Event]
    seen_xy: FloatArray
    area_px: FloatArray
    border: FloatArray | None = None
    hidden_m2: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Node:
    """The smoothed markers (M) of a hand at one frame.

    Attributes:
        t_s: its moment.
        position: (M, 3) metres; NaN = not known.
        velocity: (M, 3) metres per second.
        covariance: (M, 6, 6).
        hidden_m2: (M,) variance of each for paint that no camera shows, each axis, square metres.
        shown: (M,) whether the frame showed each where it is.
        camera: index of the camera that took it.
    """

    t_s: float
    position: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    hidden_m2: FloatArray
    shown: BoolArray
    camera: int


Correct = Callable[[Sequence[Frame], Sequence[State]], list[Views]]
"""Returns the views of frames as what they saw is to be understood when the markers were as the states tell."""


def smooth(
    frames: Sequence[Frame],
    count: int,
    settings: FilterSettings,
    correct: Correct,
) -> list[Node]:
    """Return the nodes of a hand of `count` markers at each of the frames, in order of time.

    Args:
        frames: in order of time; their views are replaced.
        count: of the hand's markers.
        settings: of the filter.
        correct: what is done to the views once the markers' path is known.
    """
    variance = [frame.views.variance for frame in frames]
    steps, evidence = _forward(frames, count, settings, variance, [None] * len(frames))
    scale2 = _scales(evidence, [step.dt_s for step, _ in steps], settings)
    states = _backward(_forward(frames, count, settings, variance, scale2)[0])
    for _ in range(1, _PASSES):
        for frame, views in zip(frames, correct(frames, states), strict=True):
            frame.views = views
        variance = [
            frame.views.variance * np.maximum(1.0, _off_path2(frame.views, state) / _DOUBT)[:, None]
            for frame, state in zip(frames, states, strict=True)
        ]
        states = _backward(_forward(frames, count, settings, variance, scale2)[0])
    nodes = [_node(frame, state, settings) for frame, state in zip(frames, states, strict=True)]
    _extend(frames, nodes, settings)
    return nodes


def _forward(
    frames: Sequence[Frame],
    count: int,
    settings: FilterSettings,
    variance: list[FloatArray],
    scale2: list[float | None],
) -> tuple[list[tuple[Step, BoolArray]], list[FloatArray]]:
    # What the live filter refused stays out; among the rest there is no gate, but doubt.
    hand = JointFilter(count, settings.motion, settings.track.gate, refuses=False)
    steps, evidence, loose_m2 = [], [], settings.track.loose_m**2
    begins = _begins(frames)
    for number, (frame, own, scale) in enumerate(zip(frames, variance, scale2, strict=True)):
        new = np.zeros(count, dtype=bool)
        for event in begins.get(number, ()):
            if not (event.goes_on and hand.state.alive[event.marker]):
                _begin(hand, event, frame.t_s, settings)
                new[event.marker] = True
        alive = hand.state.alive[frame.views.index] & frame.taken
        # Of what is hardly known, a far view tells nothing: the path would run away with it.
        certain = np.where(hand.state.spread_m2[frame.views.index] <= loose_m2, settings.track.far, np.inf)
        views = replace(frame.views, variance=own, certain=certain)
        if not alive.all():
            views = views.chosen(alive)
        innovation, step = hand.step(frame.t_s, views, scale)
        for event in frame.events:
            if event.initial is None:
                hand.end(event.marker)
        steps.append((Step(step.dt_s, step.transition, step.before, hand.state), new))
        evidence.append(innovation.evidence)
    return steps, evidence


def _begins(frames: Sequence[Frame]) -> dict[int, list[Event]]:
    """Return by frame the events of markers that begin with its views."""
    places = {id(frame): number for number, frame in enumerate(frames)}
    begins: dict[int, list[Event]] = {}
    ended: dict[int, int] = {}
    for number, frame in enumerate(frames):
        for event in frame.events:
            if event.initial is None:
                ended[event.marker] = number
            else:
                seen = number if event.first is None else min(places[id(event.first)], number)
                first = max(seen, ended.get(event.marker, -1) + 1)
                begins.setdefault(first, []).append(event)
    return begins


def _begin(hand: JointFilter, event: Event, t_s: float, settings: FilterSettings) -> None:
    """Put a marker in before the views that began it, somewhere about where these say."""
    assert event.initial is not None
    then_s = hand.state.t_s if hand.state.alive.any() else t_s
    mean, covariance = event.initial.mean.copy(), event.initial.covariance.copy()
    mean[:3] += (then_s - event.t_s) * mean[3:]
    covariance[:3, :3] += settings.track.ray_sigma_m**2 * np.eye(3)
    covariance[3:, 3:] += settings.track.speed_sigma**2 * np.eye(3)
    hand.begin(event.marker, mean, covariance, then_s)


def _scales(evidence: list[FloatArray], dt_s: list[float], settings: FilterSettings) -> list[float | None]:
    """Return the squared scale of each step by all frames together."""
    shares, scales2 = np.array(settings.motion.shares), np.square(settings.motion.scales)
    likelihood = [np.exp(one - one.max()) for one in evidence]
    stay = np.exp(-np.array(dt_s) / settings.motion.switch_s)
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


def _backward(steps: list[tuple[Step, BoolArray]]) -> list[State]:
    """Return the smoothed states of the steps; a marker (M,) that is new in one is another one than before."""
    states = [step.after for step, _ in steps]
    for number in range(len(steps) - 2, -1, -1):
        own, (following, new) = steps[number][0].after, steps[number + 1]
        later = states[number + 1]
        both = own.alive & following.before.alive & later.alive & ~new
        if not both.any():
            continue
        rows, every = _rows(both), _rows(own.alive)
        before = following.before.P[np.ix_(rows, rows)]
        before[np.diag_indices(len(rows))] += _JITTER
        moved = following.transition[rows] @ own.P[:, every]
        gain = np.linalg.solve(before, moved).T
        x, S = own.x.copy(), own.P.copy()
        x[every] += gain @ (later.x - following.before.x)[rows]
        S[np.ix_(every, every)] += gain @ (later.P[np.ix_(rows, rows)] - before) @ gain.T
        states[number] = State(own.t_s, x, S, own.weight, own.alive)
    return states


def _rows(alive: BoolArray) -> IndexArray:
    """Return the rows of markers (M,) that are alive, and of what they share, in a state."""
    return np.flatnonzero(np.concatenate([np.tile(np.repeat(alive, 3), 2), np.ones(SHARED, dtype=bool)]))


def _off_path2(views: Views, state: State) -> FloatArray:
    """Return the squared Mahalanobis distance (N,) of views from a smoothed path; 0 where there is none."""
    xy, _ = _seen(views, *state.mean.reshape(2, len(state.alive), 3))
    return np.where(state.alive[views.index], squared_distance(views.variance, views.xy - xy), 0.0)


def _seen(views: Views, position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where views (N, 2) would see places and velocities (M, 3), and the derivatives (N, 2, 3) by places."""
    R = views.camera.R_camera_rig
    there = position[views.index] + views.delta_s[:, None] * velocity[views.index]
    local = there @ R.T + views.camera.t_camera_rig
    depth = np.maximum(local[:, 2:], 0.05)
    xy = local[:, :2] / depth
    return xy, (R[:2] - xy[:, :, None] * R[2]) / depth[:, :, None]


def _on_path(frame: Frame, position: FloatArray, velocity: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distance (N,) of a frame's views that tells which show a marker where it is.

    As the gate of the live filter does, it allows for what hides some of a marker and for the error (M, 3, 3) of the
    path itself.
    """
    views = frame.views
    xy, J = _seen(views, position, velocity)
    S = J @ covariance[views.index] @ np.swapaxes(J, 1, 2)
    variance = views.variance + (views.slack * views.slack)[:, None] * ROUND + S.reshape(-1, 4)[:, (0, 1, 3)]
    # What is added for hidden paint may be too much: a view shows its marker where it is seen, too.
    return np.minimum(squared_distance(variance, views.xy - xy), squared_distance(variance, frame.seen_xy - xy))


def _node(frame: Frame, state: State, settings: FilterSettings) -> Node:
    count = len(state.alive)
    position, velocity = state.mean.reshape(2, count, 3).copy()
    diagonal = np.arange(count)
    P = state.covariance.reshape(2, count, 3, 2, count, 3)[:, diagonal, :, :, diagonal].reshape(count, 6, 6)
    shown, index = np.zeros(count, dtype=bool), frame.views.index
    shown[index] = state.alive[index] & (_on_path(frame, position, velocity, P[:, :3, :3]) <= settings.track.gate)
    position[~state.alive] = np.nan
    hidden_m2 = np.zeros(count) if frame.hidden_m2 is None else frame.hidden_m2
    return Node(state.t_s, position, velocity, P, hidden_m2, shown, frame.camera)


def _extend(frames: Sequence[Frame], nodes: list[Node], settings: FilterSettings) -> None:
    """Carry markers back from where they began to views before that fit."""
    for number, events in _begins(frames).items():
        for marker in {event.marker for event in events if not event.goes_on}:
            first = nodes[number]
            for before in range(number - 1, -1, -1):
                node, earlier = nodes[before], frames[before]
                mine = earlier.views.index == marker
                dt = node.t_s - first.t_s
                if dt < -settings.track.pair_s or earlier.taken[mine].any():
                    break
                F = np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(3))
                carried, covariance = first.position.copy(), first.covariance.copy()
                carried[marker] += dt * first.velocity[marker]
                covariance[marker] = F @ covariance[marker] @ F.T
                off2 = _on_path(earlier, carried, first.velocity, covariance[:, :3, :3])[mine]
                if not (off2 <= settings.track.gate).any():
                    continue
                node.position[marker], node.velocity[marker] = carried[marker], first.velocity[marker]
                node.covariance[marker] = covariance[marker]
                node.shown[marker] = True
