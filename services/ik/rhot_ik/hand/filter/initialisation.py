"""Initialisation of a hand from a single sample."""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.rotations import rotation_x, rotation_z
from rhot_ik.hand.filter.evidence import Evidence, EvidenceModel, HandObservation
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.process import HandState

_ROLLS_DEG: Final = (0.0, 60.0, -60.0, 120.0, -120.0, 180.0)
_PITCHES_DEG: Final = (5.0, 40.0)
"""The tips usually hang below the plane of the palm, so the palm is pitched up from their direction."""
_MOST_AWAY: Final = 0.3
"""Guesses whose back points further away from the cameras than this (cosine) are not tried: the steps turn little."""
_QUARTER: Final = 0.5
"""Palms whose sideways axes are less parallel than this (cosine) lie a quarter turn apart, not half a turn or none."""
_REFINED: Final = 3
_TURNED_AWAY_COST: Final = 1e4
"""A flat patch that is seen faces the cameras: cost of the square of how far its normal points away."""


class HandInitialiser:
    """Finds the state that explains one sample best: many guesses, each refined.

    Args:
        hand_filter: of the hand.
        evidence: how points are trusted.
        base_offset: (3,) metres: the base marker's centre in the wrist frame.
        viewpoint: (3,) metres, rig frame: where the cameras are, all in all.
    """

    def __init__(
        self, hand_filter: HandFilter, evidence: EvidenceModel, base_offset: FloatArray, viewpoint: FloatArray
    ) -> None:
        self._filter = hand_filter
        self._evidence = evidence
        self._base_offset = base_offset
        self._viewpoint = viewpoint

    def find(
        self, seen: HandObservation, person: tuple[FloatArray, FloatArray] | None = None
    ) -> tuple[HandState, Evidence] | None:
        """Return the best state and the evidence it was judged by; None without the base or a tip seen well.

        `person` is what is known of the hand from before, see `HandState.personal_parameters`.
        """
        # What is only bridged may have been anything; a measured tip tells one end of the patch from the other.
        visible = seen.tips_seen & seen.tips_measured
        well = visible if seen.tips_certain is None else visible & seen.tips_certain
        if seen.base is None or not well.any():
            return None
        direction = seen.tips[visible].mean(axis=0) - seen.base
        if direction @ direction < 1e-6:
            return None
        by_patch = self._on_patch(seen, seen.base, visible, person)
        if by_patch:
            _, best, evidence = min(by_patch, key=lambda item: item[0])
            return best, evidence
        points = self._evidence.assess(seen, None)
        tried = []
        for R in self._facing(guesses(direction), seen.base):
            start = self._filter.start(R, seen.base - R @ self._base_offset, None, person, ~visible)
            state = self._filter.update(start, points)
            tried.append((self.cost(state, points), state))
        refined = []
        for _, state in sorted(tried, key=lambda item: item[0])[:_REFINED]:
            evidence = self._evidence.assess(seen, state.R)
            final = self._filter.update(self._filter.start(state.R, state.p, state.angles, person), evidence, steps=4)
            refined.append((self.cost(final, evidence), final, evidence))
        _, best, evidence = min(refined, key=lambda item: item[0])
        return best, evidence

    def quarter_turned(self, state: HandState, seen: HandObservation) -> HandState | None:
        """Return the better of the two states with the palm a quarter turn off on its patch; None without a tip."""
        visible = seen.tips_seen & seen.tips_measured
        if seen.base is None or not visible.any():
            return None
        turned = [
            (cost, found)
            for cost, found, _ in self._on_patch(seen, seen.base, visible, None)
            if abs(found.R[:, 0] @ state.R[:, 0]) < _QUARTER
        ]
        return min(turned, key=lambda item: item[0])[1] if turned else None

    def _on_patch(
        self,
        seen: HandObservation,
        base: FloatArray,
        visible: BoolArray,
        person: tuple[FloatArray, FloatArray] | None,
    ) -> list[tuple[float, HandState, Evidence]]:
        """Return cost, state and evidence of each way round that the patch may lie; none where its corners tell none.

        From the tips alone a palm is looked for in their direction, and a lone curled finger points anywhere.
        """
        found = []
        for R in self._facing(self._evidence.patch_orientations(seen), base):
            evidence = self._evidence.assess(seen, R)
            if evidence.rotation is None:
                continue
            start = self._filter.start(R, base - R @ self._base_offset, None, person, ~visible)
            state = self._filter.update(start, evidence, steps=4)
            found.append((self.cost(state, evidence), state, evidence))
        return found

    def _facing(self, rotations: list[FloatArray], at: FloatArray) -> list[FloatArray]:
        """Return the rotations that show the cameras a flat patch; all when there is none, or none does."""
        if self._evidence.outline is None:
            return rotations
        sight = self._sight(at)
        facing = [R for R in rotations if R[:, 1] @ sight < _MOST_AWAY]
        return facing or rotations

    def _sight(self, at: FloatArray) -> FloatArray:
        """Return the unit direction (3,) in which the cameras look at a point (3,)."""
        ray = at - self._viewpoint
        direction: FloatArray = ray / max(float(np.sqrt(ray @ ray)), 1e-9)
        return direction

    def cost(self, state: HandState, evidence: Evidence) -> float:
        """Return how ill a state explains a sample, the side of the hand that the cameras see included."""
        away = float(state.R[:, 1] @ self._sight(state.p))
        cost = self._filter.cost(state, evidence)
        if self._evidence.outline is not None:
            return cost + _TURNED_AWAY_COST * max(0.0, away + 0.1) ** 2
        # Nothing tells the sides apart but the hand itself; the back is a little likelier.
        return cost + away


def guesses(direction: FloatArray) -> list[FloatArray]:
    """Return rotations (3, 3), wrist to rig, of hands whose tips lie in a direction (3,) from the wrist."""
    back = -direction / np.sqrt(direction @ direction)
    up = np.array([0.0, 0.0, -1.0])
    if abs(up @ back) > 0.95:
        up = np.array([0.0, -1.0, 0.0])
    side = np.cross(up, back)
    side /= np.sqrt(side @ side)
    towards_tips = np.column_stack([side, np.cross(back, side), back])
    return [
        towards_tips @ rotation_z(np.radians(roll)) @ rotation_x(np.radians(pitch))
        for roll in _ROLLS_DEG
        for pitch in _PITCHES_DEG
    ]
