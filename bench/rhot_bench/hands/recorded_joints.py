"""Recorded hands: what is read of the files, and what our solver and plain FABRIK make of wrist and tips."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.rig import HandFile, IkConfig, MarkerConfig
from rhot_bench.hands.recorded_hands import palm_rotations, plain_hand
from rhot_bench.processes import read_table
from rhot_ik.hand.filter.evidence import HandObservation
from rhot_ik.hand.solver import HandSolver

RATE_HZ: Final = 30.0
PREFIXES: Final = "TIMRP"
_FIXED_METACARPALS: Final = (1, 2)
_WORTH: Final = 100
"""Frames follow one another closely: all together they count as this many."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """Frames of one hand.

    Attributes:
        wrists: (N, 3) metres.
        chains: (N, 5, 4, 3) metres, thumb first: knuckle, two hinges, tip; NaN where the file tells nothing.
        across: (N, 3) unit direction of the wrist from its thumb's side to the other; NaN where it is one point.
        palms: (N, 3) metres: middle of the palm; NaN where the file tells nothing.
    """

    wrists: FloatArray
    chains: FloatArray
    across: FloatArray
    palms: FloatArray

    def part(self, rows: slice) -> Recorded:
        """Return some of the frames."""
        return Recorded(self.wrists[rows], self.chains[rows], self.across[rows], self.palms[rows])


def read_joints(path: Path, wrist: Sequence[str], chains: Sequence[Sequence[str]], palm: str = "") -> Recorded:
    """Return recorded joints in metres of a file in millimetres.

    Args:
        path: the file; columns are `<joint>_x`, `_y`, `_z`.
        wrist: the joint, or its two sides, that of the thumb first; their middle is the wrist.
        chains: per finger the four joints; an empty name = not in the file.
        palm: the middle of the palm, or not in the file.

    Raises:
        ConfigError: it cannot be read, or a joint is missing.
    """
    table = read_table(path)

    def point(name: str) -> FloatArray:
        if not name:
            return np.full((len(next(iter(table.values()))), 3), np.nan)
        try:
            return np.stack([table[f"{name}_{axis}"] for axis in "xyz"], axis=-1) / 1000.0
        except KeyError as error:
            raise ConfigError(f"{path}: has no column {error.args[0]}; it has {', '.join(table)}") from error

    sides = [point(name) for name in wrist]
    across = sides[-1] - sides[0] if len(sides) > 1 else point("")
    return Recorded(
        np.mean(sides, axis=0),
        np.stack([np.stack([point(name) for name in chain], axis=1) for chain in chains], axis=1),
        across / np.linalg.norm(across, axis=1, keepdims=True),
        point(palm),
    )


def whole_chains() -> list[list[str]]:
    """Return the joint names of files that hold 21 joints."""
    return [[f"{finger}_{joint}" for joint in ("mcp", "pip", "dip", "tip")] for finger in PREFIXES]


def joined(recordings: Iterable[Recorded]) -> Recorded:
    """Return all frames of several recordings."""
    parts = list(recordings)
    wrists, chains, across, palms = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("wrists", "chains", "across", "palms")
    )
    return Recorded(wrists, chains, across, palms)


def on_its_palm(model: HandModel, recorded: Recorded) -> FloatArray:
    """Return chains (N, 5, 4, 3) in the wrist frame, beginning in the model's knuckles: the palm's pose is given."""
    R = palm_rotations(recorded.wrists, recorded.chains, model.knuckles)
    local: FloatArray = (recorded.chains - recorded.wrists[:, None, None]) @ R[:, None]
    local[:, :, 0] = model.knuckles
    return local


def solved(model: HandModel, recorded: Recorded) -> FloatArray:
    """Return chains (N, 5, 4, 3), metres, that the hand solver finds from wrist and tips alone, frame after frame.

    The direction across the wrist is used where it is known. Frames in which it finds no hand are NaN.
    """
    bare = dataclasses.replace(model, marker_offsets_m=dict.fromkeys((*FINGERS, "base"), (0.0, 0.0, 0.0)))
    markers = {finger: MarkerConfig(joint=f"{finger}_tip") for finger in FINGERS}
    solver = HandSolver(bare, markers | {"base": MarkerConfig(joint="wrist")}, "base", IkConfig())
    found = np.full(recorded.chains.shape, np.nan)
    all_seen = np.ones(5, dtype=np.bool_)
    for k, (wrist, chains) in enumerate(zip(recorded.wrists, recorded.chains, strict=True)):
        t_ns = 10**18 + round(k / RATE_HZ * 1e9)
        across = _known(recorded.across[k])
        seen = HandObservation(t_ns, wrist, True, None, chains[:, 3], all_seen, across=across)
        solution = solver.solve(seen)
        if solution is not None:
            T = solution.T_rig_wrist
            found[k] = bare.finger_chains(solution.angles)[0] @ T[:3, :3].T + T[:3, 3]
    return found


def plain(model: HandModel, recorded: Recorded) -> FloatArray:
    """Return chains (N, 5, 4, 3), metres, of plain FABRIK from wrist and tips."""
    rows = zip(recorded.wrists, recorded.chains[:, :, 3], recorded.across, strict=True)
    return np.array([plain_hand(model, wrist, tips, _known(across)) for wrist, tips, across in rows])


def error_mm(found: FloatArray, truth: FloatArray, fingers: slice, joints: slice) -> float:
    """Return the mean distance of some joints of some fingers, millimetres, where both are known."""
    apart = np.linalg.norm(found - truth, axis=-1)[:, fingers, joints]
    return float(np.nanmean(apart) * 1e3) if np.isfinite(apart).any() else float("nan")


def fit_open_hand(recorded: Recorded) -> HandModel:
    """Return a person of whom no knuckle was recorded: the default hand, with lengths as the outstretched fingers show.

    Per finger the reach from the middle joint to the tip, and over all fingers the reach from the wrist to the middle
    joint, are those that 2 % of the frames exceed. Knuckle and first bone of index and middle finger, whose metacarpals
    stand fixed in the palm, are those about which their middle joints turn.
    """
    model = HandModel.from_file(HandFile(), "right")
    bones, chains = model.bones.copy(), recorded.chains
    straight = model.finger_chains(np.zeros((5, 4)))[0]
    ratios = []
    for finger in range(1, 5):
        outer = np.percentile(np.linalg.norm(chains[:, finger, 3] - chains[:, finger, 1], axis=1), 98)
        bones[finger, 1:] *= outer / bones[finger, 1:].sum()
        inner = np.percentile(np.linalg.norm(chains[:, finger, 1] - recorded.wrists, axis=1), 98)
        ratios.append(inner / np.linalg.norm(straight[finger, 1]))
    scale = float(np.median(ratios))
    bones[1:, 0] *= scale
    bones[0, 0] *= scale
    bones[0, 1:] = np.median(np.linalg.norm(np.diff(chains[:, 0, 1:], axis=1), axis=-1), axis=0)
    knuckles = model.knuckles * scale
    in_palm = (chains[:, :, 1] - recorded.wrists[:, None]) @ _palm_frames(recorded)
    for finger in _FIXED_METACARPALS:
        knuckles[finger], bones[finger, 0] = _turned_about(in_palm[:, finger], knuckles[finger], bones[finger, 0])
    return dataclasses.replace(model, bones=bones, knuckles=knuckles, metacarpals=model.metacarpals * scale)


def _palm_frames(recorded: Recorded) -> FloatArray:
    """Return rotations (N, 3, 3), wrist frame to the recording's, from the middle of the palm and across the wrist."""
    Z = recorded.wrists - recorded.palms
    Z = Z / np.linalg.norm(Z, axis=1, keepdims=True)
    X = recorded.across - Z * (recorded.across * Z).sum(axis=1, keepdims=True)
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    return np.stack([X, np.cross(Z, X), Z], axis=-1)


def _turned_about(points: FloatArray, knuckle: FloatArray, bone_m: float) -> tuple[FloatArray, float]:
    """Return knuckle (3,) and length, metres, of the bone whose end lies at points (N, 3); near the given ones."""
    expected = np.append(knuckle, bone_m)

    def off(place: FloatArray) -> FloatArray:
        reach = np.linalg.norm(points - place[:3], axis=1) - place[3]
        sphere_sigma_m = 0.002
        worth = np.sqrt(_WORTH / len(points)) / sphere_sigma_m
        expected_sigma_m = 0.010
        return np.concatenate([worth * reach, (place - expected) / expected_sigma_m])

    found = least_squares(off, expected).x
    return found[:3], float(found[3])


def _known(direction: FloatArray) -> FloatArray | None:
    return direction if np.isfinite(direction).all() else None
