"""The 1-euro filter where the 2018 thesis has it: on each camera's view of each marker, before any depth is computed.

What a camera sees jitters alike in u and v, whatever the depth; smoothed there, with a cut-off in units of the
picture, the disparity is smoothed with it, and depth is left to a filter of its own.
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
            focal_px: of each camera; β is set for pixels and works on normalised coordinates.
            markers: how many.
            config: `one_euro` and its pixel settings.
        """
        self._focal_px = tuple(focal_px)
        self._filters = [OneEuroFilter(markers, _settings(config, focal)) for focal in self._focal_px]
        self._on = config.one_euro == "pixels"

    def configure(self, config: FusionConfig) -> None:
        """Change the settings; states stay, unless the filters were off."""
        on = config.one_euro == "pixels"
        if on and not self._on:
            self.clear()
        self._on = on
        for filters, focal in zip(self._filters, self._focal_px, strict=True):
            filters.settings = _settings(config, focal)

    def clear(self) -> None:
        """Forget all views."""
        for filters in self._filters:
            filters.forget(np.arange(len(filters.value)))

    def smoothed(
        self, camera: int, markers: IndexArray, t_s: FloatArray, xy: FloatArray, max_rate: float
    ) -> FloatArray:
        """Return views (K, 2) after the filter; as they are where it is off.

        Args:
            camera: index.
            markers: (K,) indices.
            t_s: (K,) times, later than the newest of these markers.
            xy: (K, 2) normalised coordinates.
            max_rate: fastest believable motion, normalised units per second; beyond it a filter starts over.
        """
        if not self._on or not len(markers):
            return xy
        filters = self._filters[camera]
        views = np.column_stack([xy, np.zeros(len(xy))])
        step = np.linalg.norm(views - filters.value[markers], axis=1)
        elapsed = t_s - filters.t_s[markers]
        # Also where nothing is known yet: comparisons with NaN are false.
        follows = step <= max_rate * elapsed
        for place in np.flatnonzero(~follows):
            filters.start(markers[place : place + 1], views[place : place + 1], float(t_s[place]))
        if follows.any():
            filters.update(markers[follows], views[follows], t_s[follows][:, None])
        smoothed: FloatArray = filters.value[markers, :2]
        return smoothed


def _settings(config: FusionConfig, focal_px: float) -> OneEuroSettings:
    # β is in hertz per pixel a second; the filter's speed is in normalised units a second.
    return OneEuroSettings(config.pixel_min_cutoff_hz, config.pixel_beta * focal_px, config.derivative_cutoff_hz)
