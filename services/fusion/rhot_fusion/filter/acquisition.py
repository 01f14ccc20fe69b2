"""Finding markers that are not known, or that went where nothing expected them.

A place is believed when the views of two cameras or more, read at one moment, agree on it, and do so again over the
next frames: one wrong blob in one picture never does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rhot.geometry.camera import CameraModel
from rhot.rig import FusionConfig
from rhot_fusion.schedule import Schedule
from rhot_fusion.views.coherence import HandCoherence
from rhot_fusion.views.epipolar import EpipolarModel
from rhot_fusion.views.sightings import BoolArray, FloatArray, IndexArray
from rhot_fusion.views.tracks import LONGEST_GAP, ROWS_SHARE, Tracks
from rhot_fusion.views.triangulate import Prior, Triangulation, Views

_GATE_SIGMAS = 5.0
_SMALLEST_NOISE_PX = 0.05
_AGREEMENT_S = 0.2
CONFIRMATIONS = 3
"""Points that must agree one after another."""
_OCCUPIED_M = 0.010
"""Two markers are never nearer to each other than this: a place within it belongs to the one that is there."""


@dataclass(frozen=True, slots=True)
class Found:
    """Markers that were found.

    Attributes:
        index: (N,) markers.
        position: (N, 3) metres, rig frame.
        covariance: (N, 3, 3) square metres.
        views: (C, N) which cameras saw them.
        t_s: when.
    """

    index: IndexArray
    position: FloatArray
    covariance: FloatArray
    views: BoolArray
    t_s: float


class Acquisition:
    """Candidates of M markers."""

    def __init__(self, cameras: Sequence[CameraModel], count: int, hands: HandCoherence) -> None:
        self._triangulation = Triangulation(cameras)
        self._focal_px = float(np.mean([camera.K[0, 0] for camera in cameras]))
        self._hands = hands
        self._candidate: FloatArray = np.full((count, 3), np.nan)
        self._candidate_s: FloatArray = np.full(count, -np.inf)
        self._agreed = np.zeros(count, dtype=np.int64)

    def clear(self) -> None:
        """Forget all candidates."""
        self._candidate[:] = np.nan
        self._candidate_s[:] = -np.inf
        self._agreed[:] = 0

    def agreed(self, marker: int) -> int:
        """Return how many points of a marker have agreed one after another."""
        return int(self._agreed[marker])

    def propose(
        self,
        index: IndexArray,
        tracks: Tracks,
        doubt: FloatArray,
        schedule: Schedule,
        epipolar: EpipolarModel,
        config: FusionConfig,
        known: FloatArray,
        tracked: BoolArray,
        counts: Counter[str],
    ) -> Found | None:
        """Look for markers (N,); return those that are confirmed, or None.

        Args:
            index: markers seen where they were not expected.
            tracks: of all cameras, uncorrected.
            doubt: (C, M) standard deviation of each camera's newest view beyond its noise, normalised units.
            schedule: of the cameras.
            epipolar: corrects the tracks.
            config: volume and limits.
            known: (M, 3) where the tracked markers are expected, metres.
            tracked: (M,) which are.
            counts: takes `gated` and `behind_cameras`.
        """
        moment_s = schedule.common_moment()
        if not np.isfinite(moment_s):
            return None
        period_s = schedule.longest_period_s
        shot = tracks.at(moment_s, ROWS_SHARE * period_s, LONGEST_GAP * period_s)
        index = index[shot.valid[:, index].sum(axis=0) >= 2]
        # The same pair again tells nothing new.
        index = index[self._candidate_s[index] < moment_s]
        if not len(index):
            return None
        xy, used = epipolar.correct(shot.xy[:, index]), shot.valid[:, index]
        noise_px = max(epipolar.spread_px / np.sqrt(2.0), _SMALLEST_NOISE_PX)
        nothing = Prior(np.full((len(index), 3), np.nan), np.ones(len(index)))
        noise = noise_px / self._focal_px
        solution = self._triangulation.solve(Views(xy, used), nothing, noise)
        low, high = np.array(config.volume_m)
        gate_px = min(1.0 + _GATE_SIGMAS * epipolar.spread_px, max(config.epipolar_limit_px, 2.0))
        with np.errstate(invalid="ignore"):
            inside = ((solution.position >= low) & (solution.position <= high)).all(axis=1)
            near = self._hands.near(index, solution.position, known, tracked)
            away = np.sqrt(((solution.position[:, None] - known[None]) ** 2).sum(axis=2))
        others = tracked[None] & (np.arange(len(known))[None] != index[:, None])
        free = ~((away < _OCCUPIED_M) & others).any(axis=1)
        good = inside & near & free & (solution.residual <= gate_px / self._focal_px)
        counts["behind_cameras"] += int(np.count_nonzero(~solution.in_front))
        counts["gated"] += int(np.count_nonzero(~good))
        worse = 1.0 + (np.where(used, doubt[:, index], 0.0).max(axis=0) / noise) ** 2
        covariance = solution.covariance * worse[:, None, None]
        index, position, covariance = index[good], solution.position[good], covariance[good]
        if not len(index):
            return None
        elapsed = moment_s - self._candidate_s[index]
        spread = np.sqrt(np.einsum("nii->n", covariance))
        step = np.linalg.norm(position - self._candidate[index], axis=1)
        with np.errstate(invalid="ignore"):
            agrees = (elapsed < _AGREEMENT_S) & (step <= 0.5 * config.max_speed_m_s * elapsed + 3.0 * spread)
        self._agreed[index] = np.where(agrees, self._agreed[index] + 1, 1)
        self._candidate[index], self._candidate_s[index] = position, moment_s
        sure = self._agreed[index] >= CONFIRMATIONS
        if not sure.any():
            return None
        self._agreed[index[sure]] = 0
        return Found(index[sure], position[sure], covariance[sure], used[:, good][:, sure], moment_s)
