"""The paired methods: evaluate all cameras' tracks at a common time and compute points from them.

The time is as late as the extrapolation of the other cameras' tracks allows; see `schedule` and `tracks`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from rhot.geometry.camera import CameraModel
from rhot.rig import FusionConfig, HandFile, MarkerConfig
from rhot_fusion.paired.association import Association
from rhot_fusion.paired.pixel_filter import PixelFilters
from rhot_fusion.schedule import Schedule
from rhot_fusion.views.epipolar import EpipolarModel
from rhot_fusion.views.sightings import Outcome, Sightings
from rhot_fusion.views.tracks import LONGEST_GAP, ROWS_SHARE, Tracks


class PairedTracker:
    """Triangulation, or the depth law, of tracks at common times; see `Tracker`."""

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        markers: Mapping[str, MarkerConfig],
        hand: HandFile,
        periods_s: Sequence[float],
        config: FusionConfig,
        counts: Counter[str],
    ) -> None:
        """Build from the rig's parts; increments `measured`, `gated`, `behind_cameras` and `late_marker` of counts.

        Raises:
            ConfigError: the configured method cannot use the cameras.
        """
        self._config = config
        self._counts = counts
        self._association = Association(cameras, markers, hand.length_m, config, counts)
        self._schedule = Schedule(list(periods_s))
        self._tracks = Tracks(len(cameras), len(markers))
        self._pixels = PixelFilters([float(camera.K[0, 0]) for camera in cameras], len(markers), config)
        self._cameras = len(cameras)

    @property
    def epipolar(self) -> EpipolarModel:
        """Estimated epipolar residuals of the cameras."""
        return self._association.epipolar

    @epipolar.setter
    def epipolar(self, model: EpipolarModel) -> None:
        self._association.epipolar = model

    def configure(self, config: FusionConfig) -> None:
        """Change the settings.

        Raises:
            ConfigError: the new method cannot use the cameras; the old settings stay in force.
        """
        self._association.configure(config)
        self._config = config
        self._pixels.configure(config)

    def clear(self) -> None:
        """Discard all markers; the estimated epipolar residuals are kept."""
        self._schedule.clear()
        self._tracks.clear()
        self._pixels.clear()
        self._association.clear()

    def advance(self, sightings: Sightings) -> Outcome | None:
        """Process a frame; return the markers at the next common time if it was reached."""
        camera, t = sightings.camera, sightings.times_s
        later = t > self._tracks.last_t_s[camera, sightings.index]
        self._counts["late_marker"] += int(np.count_nonzero(~later))
        low, high = self._config.volume_m
        max_rate = self._config.max_speed_m_s / max(0.5 * (low[2] + high[2]), 0.1)
        index, t, xy = sightings.index[later], t[later], sightings.xy[later]
        self._tracks.append(camera, index, t, self._pixels.smoothed(camera, index, t, xy, max_rate), max_rate)
        self._schedule.arrived(camera, sightings.t_s)
        moment_s = self._schedule.moment(self._config.extrapolation)
        if moment_s is None:
            return None
        period_s = max(self._schedule.period_s(index) for index in range(self._cameras))
        reach_s = (self._config.extrapolation + ROWS_SHARE) * period_s
        shot = self._tracks.at(moment_s, reach_s, LONGEST_GAP * period_s)
        return self._association.advance(shot, moment_s, period_s)
