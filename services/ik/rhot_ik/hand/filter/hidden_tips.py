"""What is expected of a tip that no camera sees: it is behind something, and not inside of anything.

As far as a hand alone can tell, it is behind the hand's own flesh. Seen from the cameras, flesh is a set of segments
with a radius: metacarpals, first and second bones of all fingers. A tip that lies beside all of them would be seen; it
is therefore expected within the outline of the nearest one. That is one direction of one point, known to `sigma_m`; the
other two stay open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rhot.anatomy.hand import MOVING, HandModel
from rhot.arrays import BoolArray, FloatArray
from rhot_ik.hand.contact import Shape
from rhot_ik.hand.filter.evidence import Rows
from rhot_ik.hand.filter.process import HandState


@dataclass(frozen=True, slots=True)
class OcclusionSettings:
    """What hides a tip.

    Attributes:
        inside_m: a hidden tip lies at least this far inside an outline: half its own radius, for more than half of its
            paint has to be covered.
        sigma_m: flesh is no capsule, and cameras differ from their mean in where they look from.
        open_m: standard deviation of the directions that are left open.
    """

    inside_m: float = 0.004
    sigma_m: float = 0.006
    open_m: float = 0.5


class Occlusion:
    """Where hidden tips are expected; stateless.

    Args:
        radii: (15,) metres: of the five metacarpals, the five first and the five second bones.
        settings: what hides a tip.
    """

    def __init__(self, radii: FloatArray, settings: OcclusionSettings) -> None:
        self._radii, self._settings = radii, settings

    def expected(
        self, tips: FloatArray, starts: FloatArray, ends: FloatArray, viewpoint: FloatArray
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Return which tips (5,) would be seen, where they are expected then (5, 3), and with what covariance.

        Args:
            tips: (5, 3) metres: markers.
            starts, ends: (15, 3) metres: ends of the bones, in the order of `radii`.
            viewpoint: (3,) metres, in the same frame: where the cameras are.
        """
        settings = self._settings
        bones = ends - starts
        sight = starts.mean(axis=0) - viewpoint
        sight /= np.sqrt(sight @ sight)
        across = np.eye(3) - np.outer(sight, sight)
        flat = bones @ across
        reach = np.maximum((flat * flat).sum(-1), 1e-9)
        off = tips[:, None] - starts
        along = np.clip((off @ across * flat).sum(-1) / reach, 0.0, 1.0)
        gap = off - along[..., None] * bones
        behind = gap @ sight
        gap = gap @ across
        distance = np.sqrt((gap * gap).sum(-1))
        excess = distance - self._radii + settings.inside_m
        # What is not behind a bone is not hidden by it, and would have to go round it first.
        excess += np.maximum(0.0, self._radii - behind)
        nearest = np.argmin(excess, axis=1)
        rows = np.arange(len(tips))
        by = excess[rows, nearest]
        towards = -gap[rows, nearest] / np.maximum(distance[rows, nearest], 1e-6)[:, None]
        return by > 0.0, tips + by[:, None] * towards, self.along(towards, settings.sigma_m)

    def along(self, directions: FloatArray, sigma_m: float) -> FloatArray:
        """Return covariances (N, 3, 3) of points that are known along unit directions (N, 3) alone, to `sigma_m`."""
        outer = directions[:, :, None] * directions[:, None, :]
        open_m = self._settings.open_m
        covariances: FloatArray = open_m**2 * np.eye(3) + (sigma_m**2 - open_m**2) * outer
        return covariances


class HiddenTips:
    """Adds what is expected of hidden tips to what a sample measures; stateless.

    Args:
        model: the hand.
        contact_m: how far fingers sink into what they hold.
        viewpoint: (3,) metres, rig frame: where the cameras are; none when nothing is known of what hides a tip.
    """

    def __init__(self, model: HandModel, contact_m: float, viewpoint: FloatArray | None) -> None:
        self._model, self._contact_m, self._viewpoint = model, contact_m, viewpoint
        radii = model.radii[MOVING]
        self._tip_m = radii[:, 3]
        bones = [radii[:, 0], 0.5 * (radii[:, 0] + radii[:, 1]), 0.5 * (radii[:, 1] + radii[:, 2])]
        self._occlusion = Occlusion(np.concatenate(bones), OcclusionSettings())

    def expect(self, rows: Rows, prior: HandState, markers: FloatArray, shapes: Sequence[Shape]) -> None:
        """Add to the rows what is expected of tips that they do not hold.

        Args:
            rows: of a sample; changed.
            prior: the state as it was expected.
            markers: (5, 3) metres, wrist frame, of that state.
            shapes: things that hidden fingers may have met, rig frame.
        """
        hidden = ~rows.seen[:5]
        tips = markers @ prior.R.T + prior.p
        counts = rows.counts[:15].reshape(5, 3)
        if self._viewpoint is not None:
            chain = self._model.finger_chains(prior.angles.reshape(5, 4))[0] @ prior.R.T + prior.p
            wrist = np.broadcast_to(prior.p, (5, 3))
            starts, ends = np.concatenate([wrist, chain[:, 0], chain[:, 1]]), chain[:, :3].swapaxes(0, 1).reshape(15, 3)
            would, points, covariances = self._occlusion.expected(tips, starts, ends, self._viewpoint)
            would &= hidden
            rows.points[:5][would], rows.noise[:5][would], counts[would] = points[would], covariances[would], 1.0
        for shape in shapes:
            distance, out = shape.distance(tips)
            inside = hidden & (distance < self._tip_m)
            rows.points[:5][inside] = (tips + (self._tip_m - distance)[:, None] * out)[inside]
            rows.noise[:5][inside] = self._occlusion.along(out, self._contact_m)[inside]
            counts[inside] = 1.0
