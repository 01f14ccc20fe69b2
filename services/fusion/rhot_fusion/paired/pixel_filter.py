"""The 1-euro filter as in the 2018 thesis: on each camera's view of each marker, before depth is computed.

The noise of an image position is the same in u and v and at any depth. Smoothing it, with a cut-off in image units,
also smooths the disparity; depth has a separate filter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rhot.arrays import FloatArray, IndexArray
from rhot.rig import FusionConfig
from rhot_fusion.paired.one_euro import OneEuroFilter, OneEuroSettings


class PixelFilters:
    """1-euro filters of C cameras and M markers; normalised image coordinates and seconds."""

    def __init__(self, focal_px: Sequence[float], markers: int, config: FusionConfig) -> None:
        """Build the filters.

        Args:
            focal_px: of each camera; converts β from pixels to normalised coordinates.
            markers: their number.
            config: `one_euro` and its pixel settings.
        """
        self._focal_px = tuple(focal_px)
        self._filters = [OneEuroFilter(markers, _settings(config, focal)) for focal in self._focal_px]
        self._on = config.one_euro == "pixels"

    def configure(self, config: FusionConfig) -> None:
        """Change the settings; the states are kept unless the filters were off."""
        on = config.one_euro == "pixels"
        if on and not self._on:
            self.clear()
        self._on = on
        for filters, focal in zip(self._filters, self._focal_px, strict=True):
            filters.settings = _settings(config, focal)

    def clear(self) -> None:
        """Discard all states."""
        for filters in self._filters:
            filters.forget(np.arange(len(filters.value)))

    def smoothed(
        self, camera: int, markers: IndexArray, t_s: FloatArray, xy: FloatArray, max_rate: float
    ) -> FloatArray:
        """Return filtered views (K, 2); unchanged if the filter is off.

        Args:
            camera: index.
            markers: (K,) indices.
            t_s: (K,) times, later than the last ones of these markers.
            xy: (K, 2) normalised coordinates.
            max_rate: highest plausible image speed, normalised units per second; a faster step restarts the filter.
        """
        if not self._on or not len(markers):
            return xy
        filters = self._filters[camera]
        views = np.column_stack([xy, np.zeros(len(xy))])
        step = np.linalg.norm(views - filters.value[markers], axis=1)
        elapsed = t_s - filters.t_s[markers]
        # Markers without a state restart, too: comparisons with NaN are false.
        follows = step <= max_rate * elapsed
        for row in np.flatnonzero(~follows):
            filters.start(markers[row : row + 1], views[row : row + 1], float(t_s[row]))
        if follows.any():
            filters.update(markers[follows], views[follows], t_s[follows][:, None])
        smoothed: FloatArray = filters.value[markers, :2]
        return smoothed


def _settings(config: FusionConfig, focal_px: float) -> OneEuroSettings:
    # β is in hertz per (pixel per second), the filter's speed in normalised units per second.
    return OneEuroSettings(config.pixel_min_cutoff_hz, config.pixel_beta * focal_px, config.derivative_cutoff_hz)
