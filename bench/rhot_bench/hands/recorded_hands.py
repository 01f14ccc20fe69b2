"""Recorded hands as truth: one person's model from some frames, and plain FABRIK to compare with.

A recording gives the wrist and per finger four joints: knuckle (MCP; thumb: carpometacarpal), two hinges, tip. All
points are in one frame of any orientation, metres; chains are (N, 5, 4, 3), thumb first.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import nearest_rotation
from rhot.messages import Side
from rhot.rig import HandFile

BENT_RAD: Final = np.radians(10.0)
"""Each hinge of the start of plain FABRIK."""
_FEW: Final = 5


def palm_rotations(wrists: FloatArray, chains: FloatArray, knuckles: FloatArray) -> FloatArray:
    """Return rotations (N, 3, 3), wrist frame to the recording's, from wrists (N, 3) and the four long knuckles.

    Args:
        wrists: metres.
        chains: (N, 5, 4, 3) metres.
        knuckles: (5, 3) metres, wrist frame, of the person.
    """
    rest = np.concatenate([np.zeros((1, 3)), knuckles[1:]])
    points = np.concatenate([wrists[:, None], chains[:, 1:, 0]], axis=1)
    points = points - points.mean(axis=1, keepdims=True)
    return nearest_rotation(np.swapaxes(points, 1, 2) @ (rest - rest.mean(axis=0)))


def fit_person(wrists: FloatArray, chains: FloatArray, side: Side) -> HandModel:
    """Return the hand of a person: bone lengths and knuckle places as the medians over frames, the rest by default.

    Where the recorded first joint of the thumb moves in the palm, it lies on the way along the first bone: that bone
    begins at the point about which its end turns.

    Args:
        wrists: (N, 3) metres.
        chains: (N, 5, 4, 3) metres.
        side: of the hand.
    """
    model = HandModel.from_file(HandFile(), side)
    knuckles = model.knuckles
    for _ in range(3):
        R = palm_rotations(wrists, chains, knuckles)
        knuckles = np.median((chains[:, :, 0] - wrists[:, None]) @ R, axis=0)
    bones = np.median(np.linalg.norm(np.diff(chains, axis=2), axis=-1), axis=0)
    thumb = (chains[:, 0, :2] - wrists[:, None]) @ palm_rotations(wrists, chains, knuckles)
    moves_m = 0.002
    if thumb[:, 0].std(axis=0).max() > moves_m:
        knuckles[0], bones[0, 0] = _turning_point(thumb[:, 1])
    metacarpals = model.metacarpals.copy()
    metacarpals[0] = knuckles[0]
    return dataclasses.replace(model, knuckles=knuckles, metacarpals=metacarpals, bones=bones)


def fit_spread(model: HandModel, chains: FloatArray) -> HandModel:
    """Return the model with limits of abduction as wide as the person's fingers really spread, or as they were.

    All but 2 % of the frames on either side lie inside; those in which the first bone stands upright do not count.

    Args:
        model: of the person, with the rest frames of its fingers.
        chains: (N, 5, 4, 3) metres, wrist frame.
    """
    low, high = model.angle_min.copy(), model.angle_max.copy()
    for finger, frame in enumerate(model.frames):
        first = (chains[:, finger, 1] - chains[:, finger, 0]) @ frame
        lying = 0.3
        first = first[-first[:, 2] > lying * model.bones[finger, 0]]
        if len(first) > _FEW:
            abduction = model.handedness * np.arctan2(-first[:, 0], -first[:, 2])
            least, most = np.percentile(abduction, (2.0, 98.0))
            low[finger, 1], high[finger, 1] = min(low[finger, 1], least), max(high[finger, 1], most)
    return dataclasses.replace(model, angle_min=low, angle_max=high)


def fit_rest_frames(model: HandModel, chains: FloatArray) -> HandModel:
    """Return the model with the rest frame of each finger as the person's fingers really bend.

    All planes in which a finger bends hold its Y axis: the direction that the planes' normals vary least in. X is their
    mean; Z is turned so that the median of abduction is 0.

    Args:
        model: of the person, with default frames.
        chains: (N, 5, 4, 3) metres, wrist frame.
    """
    frames = model.frames.copy()
    bones = np.diff(chains, axis=2)
    for finger, (X0, Y0, _) in enumerate(np.swapaxes(frames, 1, 2)):
        first, second, third = (bones[:, finger, k] for k in range(3))
        normals = np.cross(first, second) + np.cross(second, third) + np.cross(first, third)
        size = np.linalg.norm(normals, axis=1)
        normals *= (np.sign(normals @ X0) / np.maximum(size, 1e-12))[:, None]
        weights = np.clip(size / (model.bones[finger, 0] * model.bones[finger, 1]), 0.0, 1.0)[:, None]
        if weights.sum() < 1.0:
            continue
        scatter = (normals * weights).T @ normals / weights.sum()
        # The default Y axis counts as 0.3 of frames in which the finger is well bent.
        _, axes = np.linalg.eigh(scatter + 0.3 * (np.eye(3) - np.outer(Y0, Y0)))
        Y = axes[:, 0] * np.sign(axes[:, 0] @ Y0)
        mean = (normals * weights).sum(axis=0)
        X = mean - Y * (mean @ Y)
        X /= np.linalg.norm(X)
        Z = np.cross(X, Y)
        flat = first - np.outer(first @ Y, Y)
        ahead = (np.linalg.norm(flat, axis=1) > 0.6 * model.bones[finger, 0]) & (flat @ Z < 0.0)
        if finger > 0 and ahead.sum() > 5:
            turn = float(np.median(np.arctan2(flat[ahead] @ X, -(flat[ahead] @ Z))))
            X, Z = np.cos(turn) * X + np.sin(turn) * Z, np.cos(turn) * Z - np.sin(turn) * X
        frames[finger] = np.column_stack([X, Y, Z])
    return dataclasses.replace(model, frames=frames)


def plain_fabrik(bases: FloatArray, tips: FloatArray, lengths: FloatArray, start: FloatArray) -> FloatArray:
    """Return chains (N, n + 1, 3) that FABRIK finds without limits or coupling, 60 iterations.

    Args:
        bases: (N, 3) metres, as `tips`.
        tips: (N, 3).
        lengths: (N, n) of the bones.
        start: (N, n + 1, 3) chains to start from.
    """
    points = start.copy()
    for _ in range(60):
        points[:, -1] = tips
        for k in range(lengths.shape[1] - 1, -1, -1):
            points[:, k] = points[:, k + 1] + _along(points[:, k] - points[:, k + 1], lengths[:, k])
        points[:, 0] = bases
        for k in range(lengths.shape[1]):
            points[:, k + 1] = points[:, k] + _along(points[:, k + 1] - points[:, k], lengths[:, k])
    return points


def plain_fingers(model: HandModel, tips: FloatArray) -> FloatArray:
    """Return chains (N, 5, 4, 3), wrist frame, of plain FABRIK from a slightly bent hand to tips (N, 5, 3)."""
    start = _slightly_bent(model)
    count = len(tips)
    found = plain_fabrik(
        np.tile(model.knuckles, (count, 1)),
        tips.reshape(-1, 3),
        np.tile(model.bones, (count, 1)),
        np.tile(start, (count, 1, 1)),
    )
    return found.reshape(count, 5, 4, 3)


def plain_hand(model: HandModel, wrist: FloatArray, tips: FloatArray, across: FloatArray | None = None) -> FloatArray:
    """Return chains (5, 4, 3) of plain FABRIK from the wrist (3,) through the knuckles to tips (5, 3).

    The start is the slightly bent hand, turned so that its tips lie as near as can be to the given ones, and two points
    on either side of its wrist in the direction `across`, (3,), where that is known.
    """
    start = np.concatenate([np.zeros((5, 1, 3)), _slightly_bent(model)], axis=1)
    lengths = np.column_stack([np.linalg.norm(model.knuckles, axis=1), model.bones])
    scatter = (tips - wrist).T @ start[:, -1]
    if across is not None:
        half_wrist_m = 0.02
        scatter[:, 0] += 2.0 * half_wrist_m**2 * across
    R = nearest_rotation(scatter)
    return plain_fabrik(np.tile(wrist, (5, 1)), tips, lengths, start @ R.T + wrist)[:, 1:]


def _turning_point(points: FloatArray) -> tuple[FloatArray, float]:
    """Return centre (3,) and radius, metres, of the sphere on which points (N, 3) lie: |x|² = 2·c·x + (r² − |c|²)."""
    rows = np.column_stack([2.0 * points, np.ones(len(points))])
    solution = np.linalg.lstsq(rows, (points * points).sum(-1), rcond=None)[0]
    centre = solution[:3]
    return centre, float(np.median(np.linalg.norm(points - centre, axis=1)))


def _slightly_bent(model: HandModel) -> FloatArray:
    angles = np.zeros((5, 4))
    angles[:, (0, 2, 3)] = BENT_RAD
    return model.finger_chains(angles)[0]


def _along(directions: FloatArray, lengths: FloatArray) -> FloatArray:
    size = np.linalg.norm(directions, axis=1, keepdims=True)
    scaled: FloatArray = lengths[:, None] * directions / np.maximum(size, 1e-12)
    return scaled
