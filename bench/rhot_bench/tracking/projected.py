"""Blobs of two hands without pictures: where the paint is, what hides it, and which hand's it is said to be.

Rendering five minutes of pictures takes far longer than tracking them. Here each marker's true centre is projected with
noise, is hidden where flesh of either hand lies before it, and two blobs of one paint that touch become one. What the
blobs of shared paints are called is decided by the detector's own `SharedPaints`.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator
from typing import Final

import numpy as np

from rhot.anatomy.skeleton import CHAINS, JOINTS
from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.camera import CameraModel
from rhot.messages import Marker, MarkerFrame
from rhot.rig import Rig
from rhot.rig.marker_config import worn_paints
from rhot_bench.measures.hands import START_NS
from rhot_bench.speed.simulated import Moment, moments
from rhot_capture.detection.hand.sharing import SharedPaints, Spot
from rhot_capture.detection.track import MarkerTrack
from rhot_capture.timing import row_time_ns
from rhot_sim.rig.folder import true_cameras
from rhot_sim.world.world import World, WorldSample

_BLOCK: Final = 512
_NOISE_PX: Final = 0.15
"""Of a blob's centre, each axis; rendered pictures show 0.1 to 0.2."""
_CLEARANCE_M: Final = 0.015
"""Flesh hides what lies this much behind its middle: a fingertip's own flesh does not."""
_TIP_LENGTH_M: Final = 0.017
_LOSS: Final = 0.02
"""Share of blobs that are missed for no reason."""


def named_frames(rig: Rig, world: World, to_s: float, seed: int = 0) -> Iterator[MarkerFrame]:
    """Yield the marker frames of all cameras from the world's start on, in order of delivery."""
    streams = [_CameraBlobs(rig, world, name, seed).frames(to_s) for name in rig.config.cameras]
    yield from (frame for _, frame in heapq.merge(*streams, key=lambda each: each[0]))


class _CameraBlobs:
    """What one camera says of the markers, frame after frame."""

    def __init__(self, rig: Rig, world: World, name: str, seed: int) -> None:
        self._rig, self._world, self._name = rig, world, name
        self._camera: CameraModel = true_cameras(rig)[name]
        self._config = rig.config.cameras[name]
        self._names = list(world.markers)
        self._worn = worn_paints(world.markers)
        self._sharing = SharedPaints(world.markers)
        self._tracks = {marker: MarkerTrack() for marker in self._names}
        self._rng = np.random.default_rng([seed, list(rig.config.cameras).index(name)])
        self._reach_m = [_extent_m(world, marker) for marker in self._names]

    def frames(self, to_s: float) -> Iterator[tuple[float, MarkerFrame]]:
        """Yield the time of delivery and the frame."""
        block: list[Moment] = []
        for moment in moments(self._rig, 0.0, to_s):
            if moment.camera == self._name:
                block.append(moment)
            if len(block) == _BLOCK:
                yield from self._named(block)
                block = []
        if block:
            yield from self._named(block)

    def _named(self, block: list[Moment]) -> Iterator[tuple[float, MarkerFrame]]:
        config, camera = self._config, self._camera
        half_s = 0.5 * (config.exposure_s + config.readout_s)
        sample = self._world.sample(np.array([moment.t_first_row_s + half_s for moment in block]))
        centres = np.stack([sample.markers[name] for name in self._names], axis=1)
        seen = self._seen(sample, centres)
        uv = camera.project(centres.reshape(-1, 3)).reshape(*centres.shape[:2], 2)
        seen &= np.array([camera.contains(one) for one in uv]) & (self._rng.random(seen.shape) > _LOSS)
        uv += self._rng.normal(0.0, _NOISE_PX, uv.shape)
        depth = camera.to_camera(centres.reshape(-1, 3))[:, 2].reshape(centres.shape[:2])
        px_m = camera.K[0, 0] / depth
        for row, moment in enumerate(block):
            spots = {
                name: self._spot(k, uv[row, k], float(px_m[row, k]))
                for k, name in enumerate(self._names)
                if seen[row, k]
            }
            yield moment.delivered_s, self._frame(moment, self._given(spots))

    def _seen(self, sample: WorldSample, centres: FloatArray) -> BoolArray:
        """Return which markers (N, M) no flesh hides."""
        eye = self._camera.center
        away = centres - eye
        length = np.linalg.norm(away, axis=-1)
        ray = away / length[..., None]
        seen = np.ones(centres.shape[:2], dtype=bool)
        for side, joints in sample.joints.items():
            radii = self._world.hands[side].radii
            for chain in CHAINS.values():
                index = [JOINTS.index(joint) for joint in chain]
                for a, b in itertools.pairwise(index):
                    for share in (0.0, 0.5, 1.0):
                        ball = (1.0 - share) * joints.positions[:, a] + share * joints.positions[:, b] - eye
                        radius = (1.0 - share) * radii[a] + share * radii[b]
                        along = (ray * ball[:, None]).sum(-1)
                        beside2 = (ball**2).sum(-1)[:, None] - along**2
                        seen &= ~((beside2 < radius**2) & (along < length - _CLEARANCE_M))
        return seen

    def _spot(self, k: int, uv: FloatArray, px_m: float) -> Spot:
        across, down = (px_m * reach for reach in self._reach_m[k])
        return Spot(float(uv[0]), float(uv[1]), across, down, across * down, 1.0)

    def _given(self, spots: dict[str, Spot]) -> dict[str, Spot]:
        """Return the spots under the names that they are given."""
        shared = self._sharing.wearers
        named = {name: spot for name, spot in spots.items() if self._worn[name] not in shared}
        self._sharing.see_patches(named)
        for paint, pair in shared.items():
            blobs = _merged([spots[name] for name in pair if name in spots])
            found = self._sharing.match(paint, blobs, {name: self._tracks[name].expected for name in pair})
            named |= {name: blobs[number] for name, number in found.items()}
        for name, track in self._tracks.items():
            if name in named:
                track.update(named[name].u, named[name].v, named[name].area)
            else:
                track.miss()
        self._sharing.remember({name: (spot.u, spot.v) for name, spot in named.items()})
        return named

    def _frame(self, moment: Moment, spots: dict[str, Spot]) -> MarkerFrame:
        config = self._config
        t_ns = START_NS + round(1e9 * moment.t_first_row_s)
        middle_ns = row_time_ns(t_ns, 0.5 * (config.height - 1), config.height, config.exposure_s, config.readout_s)
        # Blobs are those of one moment, that of the middle row, wherever they are.
        markers = {
            name: Marker(u=spot.u, v=spot.v, area=0.0, score=0.9, t_ns=middle_ns) for name, spot in spots.items()
        }
        return MarkerFrame(
            t_ns=middle_ns,
            camera=self._name,
            width=config.width,
            height=config.height,
            markers=markers,
            frame=moment.number,
        )


def _merged(spots: list[Spot]) -> list[Spot]:
    """Return blobs of one paint; two that touch are one."""
    if len(spots) < 2:
        return spots
    a, b = spots
    if abs(a.u - b.u) > 0.5 * (a.across + b.across) or abs(a.v - b.v) > 0.5 * (a.down + b.down):
        return spots
    u, v = 0.5 * (a.u + b.u), 0.5 * (a.v + b.v)
    across, down = abs(a.u - b.u) + 0.5 * (a.across + b.across), abs(a.v - b.v) + 0.5 * (a.down + b.down)
    return [Spot(u, v, across, down, a.area + b.area, 1.0)]


def _extent_m(world: World, name: str) -> tuple[float, float]:
    marker = world.markers[name]
    if marker.size_m is not None:
        return marker.size_m
    radius_m = float(world.hands[marker.hand].radii[JOINTS.index(marker.joint)])
    return 2.0 * radius_m, max(2.0 * radius_m, _TIP_LENGTH_M)
