"""Hands and body together: what the ik service runs, and what `rhot process` feeds."""

from __future__ import annotations

from collections.abc import Mapping

from rhot.core import Explanation, Output
from rhot.messages import FootPose, HandPose, HeadPose, ObjectPose, PointSet
from rhot.rig import IkConfig, Rig
from rhot_ik.body_core import BodyCore
from rhot_ik.hand_core import HandCore


class IkCore:
    """Passes points and objects to the hands' core; head, feet and solved hands to that of the body.

    Args:
        rig: marker table, sizes and configuration.
    """

    def __init__(self, rig: Rig) -> None:
        self._hands = HandCore(rig)
        self._body = BodyCore(rig)

    def configure(self, config: IkConfig) -> None:
        """Switch to another configuration from the next sample on."""
        self._hands.configure(config)

    @property
    def figures(self) -> Mapping[str, float]:
        """Those of the hands."""
        return self._hands.figures

    @property
    def problem(self) -> str:
        """What is wrong with the rig as a whole."""
        return self._hands.problem

    @property
    def counts(self) -> Mapping[str, int]:
        """What became of the samples, of hands and body."""
        return {**self._hands.counts, **self._body.counts}

    def feed(self, message: PointSet | ObjectPose | HeadPose | FootPose | HandPose) -> list[Output]:
        """Return the hands or the body that follow from a message, with their keys.

        Hands of `feed` also update the body; those of `feed_smoothed` have to be fed in.
        """
        if isinstance(message, PointSet):
            hands = self._hands.feed(message)
            for _, hand in hands:
                if isinstance(hand, HandPose):
                    self._body.feed(hand)
            return hands
        if isinstance(message, ObjectPose) and not isinstance(message, HeadPose):
            self.feed_object(message)
            return []
        return self._body.feed(message)

    def feed_smoothed(self, points: PointSet) -> list[tuple[PointSet, list[Output]]]:
        """Process points, and return earlier ones with their smoothed hands; see `HandCore.feed_smoothed`."""
        return self._hands.feed_smoothed(points)

    def finish(self) -> list[tuple[PointSet, list[Output]]]:
        """Return the points that `feed_smoothed` has not returned yet, with their hands; call it at the end."""
        return self._hands.finish()

    def feed_object(self, pose: ObjectPose) -> None:
        """Take an object's newest pose, for contacts."""
        self._hands.feed_object(pose)

    def explain(self) -> list[Explanation]:
        """Return what the hands' core explains of itself."""
        return self._hands.explain()
