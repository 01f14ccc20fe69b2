"""The samples of one hand: what a calibration keeps of a stream of point sets."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import BoolArray, FloatArray
from rhot.atomic_file import why_unread
from rhot.bus import CONNECT_S, Bus
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.messages import MarkerFrame, Point, PointSet, decode, first_problem
from rhot.offline import marker_frames, track
from rhot.recording import Recording
from rhot.recording.mcap.reader import is_mcap, open_mcap
from rhot.rig import BusConfig, Rig
from rhot_calibration.hand.fit.parameters import HandParameters
from rhot_calibration.live import listening

# Which part of a recording shows the hand flat and which the fingers straight, and what a live one asks for when.

FLAT_S: Final = 0.5
"""A hand has to be flat for this long to be found flat."""
FLAT_STILL_M: Final = 0.004
"""Largest standard deviation of a flat hand's reach."""
FEWEST_FLAT: Final = 8
_SAME_REACH_M: Final = 0.0025
"""Per finger: reaches within this of the greatest belong to the flat hand."""
_SMOOTH_S: Final = 0.8
STRAIGHT_SHARE: Final = 0.8
"""Of the samples of a stretch, so many show straight fingers if it is a stretch of straight fingers."""
_FEWEST_FINGERS: Final = 3


@dataclass(frozen=True, slots=True)
class PoseWindow:
    """A stretch of a recording, seconds from its first sample."""

    start_s: float
    end_s: float

    def holds(self, seconds: FloatArray) -> BoolArray:
        """Return which of the times (N,) lie in it."""
        inside: BoolArray = np.asarray((seconds >= self.start_s) & (seconds <= self.end_s))
        return inside


@dataclass(frozen=True, slots=True)
class Phases:
    """When a recording shows what, as somebody says; None = to be found."""

    flat: PoseWindow | None = None
    knuckles: PoseWindow | None = None


FIND_PHASES: Final = Phases()
_PROMPTS: Final = (
    (0.0, 4.0, "get ready: back of the hand to the cameras, fingers straight, a little spread"),
    (4.0, 7.0, "hold the hand flat and still"),
    (7.0, 9.0, "get ready: bend at the knuckles only, fingers kept straight"),
    (9.0, 19.0, "knuckles: straight fingers down as far as they go and up again, three times"),
    (19.0, 21.0, "get ready: bend everything"),
    (21.0, 27.0, "bend the fingers freely, fist and open"),
)
"""Seconds from and to, and what to do meanwhile."""
LIVE_PHASES: Final = Phases(flat=PoseWindow(4.3, 7.0), knuckles=PoseWindow(9.0, 19.5))
LIVE_S: Final = _PROMPTS[-1][1]


def prompt_at(passed_s: float) -> tuple[float, str]:
    """Return how long it lasts still, seconds, and what to do, so many seconds after the start."""
    _, end_s, doing = next(one for one in reversed(_PROMPTS) if passed_s >= one[0])
    return end_s - passed_s, doing


def reaches(samples: HandSamples) -> FloatArray:
    """Return the distances (N, 5), metres, of fingertips from the base marker; NaN = not seen."""
    found: FloatArray = np.linalg.norm(samples.tips - samples.base[:, None], axis=2)
    return found


def find_flat(samples: HandSamples, steady: bool = True) -> PoseWindow:
    """Return the half second in which the four fingers together reach furthest and are still, widened while they do.

    Args:
        samples: the markers.
        steady: whether a flat hand has to be still; otherwise the least restless of the far reaches serves.

    Raises:
        CalibrationError: there is none.
    """
    seconds = samples.seconds
    sums = reaches(samples)[:, 1:].sum(axis=1)
    usable = np.flatnonzero(np.isfinite(sums))
    t, reach = seconds[usable], sums[usable]
    last: list[int] = np.searchsorted(t, t + FLAT_S).tolist()
    best, place = -np.inf, -1
    most_restless = 4.0 * FLAT_STILL_M if steady else np.inf
    for a, b in enumerate(last):
        if b >= len(t) or b - a < FEWEST_FLAT:
            continue
        window = reach[a:b]
        middle = float(np.median(window))
        spread = 1.4826 * float(np.median(np.abs(window - middle)))
        if spread <= most_restless and middle - 2.0 * spread > best:
            best, place = middle - 2.0 * spread, a
    if place < 0:
        raise CalibrationError(
            f"the hand was never seen flat and still for {FLAT_S:g} s with all four fingertips; start the recording "
            "with 3 s of the flat hand, fingers straight and a little spread, or say when that was: --flat START-END"
        )
    level = float(np.median(reach[place : last[place]])) - 4.0 * _SAME_REACH_M
    low, high = place, last[place] - 1
    ahead = np.array([np.median(reach[max(k - 3, 0) : k + 4]) for k in range(len(reach))]) >= level
    while low > 0 and ahead[low - 1]:
        low -= 1
    while high + 1 < len(t) and ahead[high + 1]:
        high += 1
    return PoseWindow(float(t[low]), float(t[high]))


def straight_stretch(seconds: FloatArray, deficit: FloatArray, limit_m: float, flat: PoseWindow) -> PoseWindow:
    """Return the longest stretch in which the fingers' tips stay on their spheres, or the flat one if none is longer.

    Args:
        seconds: (N,) times.
        deficit: (N, 4) metres by which the four fingers fall short of being straight; NaN = not seen.
        limit_m: so much is still straight.
        flat: where they are straight for sure.
    """
    seen = np.isfinite(deficit)
    with np.errstate(invalid="ignore"):
        off = (np.abs(deficit) > limit_m).sum(axis=1)
    good = (off == 0) & (seen.sum(axis=1) >= _FEWEST_FINGERS)
    judged = np.flatnonzero(seen.sum(axis=1) >= _FEWEST_FINGERS)
    t, ok = seconds[judged], good[judged].astype(np.float64)
    total = np.concatenate([[0.0], np.cumsum(ok)])
    low, high = np.searchsorted(t, t - _SMOOTH_S / 2.0), np.searchsorted(t, t + _SMOOTH_S / 2.0, side="right")
    straight = (total[high] - total[low]) / np.maximum(high - low, 1) >= STRAIGHT_SHARE
    best = flat
    start: float | None = None
    for k, one in enumerate(straight):
        if one and start is None:
            start = float(t[k])
        if start is not None and (not one or k == len(straight) - 1):
            if float(t[k]) - start > best.end_s - best.start_s:
                best = PoseWindow(start, float(t[k]))
            start = None
    return best


# Where the point sets of a hand calibration come from: a recording, a file of `rhot process`, or the running rig.

_POINTS_KEY: Final = "rhot/points"


def recorded_points(rig: Rig, recording: Recording, on_frame: Callable[[], None]) -> Iterator[PointSet]:
    """Yield the point sets of a recording, tracked by the very cores that run live; `on_frame` counts its frames."""
    for _, message in track(rig, marker_frames(rig, recording)):
        if isinstance(message, MarkerFrame):
            on_frame()
        elif isinstance(message, PointSet):
            yield message


def stored_points(file: Path) -> Iterator[PointSet]:
    """Yield the point sets in an MCAP file of `rhot record` or a JSON Lines file of `rhot process`.

    Raises:
        ConfigError: it cannot be read.
        CalibrationError: a line is not a message; names the line.
        WireError: a payload of the MCAP file is not a valid message.
    """
    if is_mcap(file):
        for sample in open_mcap(file).samples():
            if sample.key == _POINTS_KEY:
                yield decode(sample.payload, PointSet)
        return
    try:
        with file.open(encoding="utf-8-sig") as lines:
            for number, line in enumerate(lines, start=1):
                if line.strip():
                    found = _points_of(f"{file}:{number}", line)
                    if found is not None:
                        yield found
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error


def _points_of(where: str, line: str) -> PointSet | None:
    try:
        entry = json.loads(line)
    except (json.JSONDecodeError, RecursionError) as error:
        raise CalibrationError(f"{where}: not JSON ({error}); give a file that `rhot process --out` wrote") from error
    if not isinstance(entry, dict) or "key" not in entry or "value" not in entry:
        raise CalibrationError(f'{where}: not {{"key": …, "value": …}}; give a file that `rhot process --out` wrote')
    if entry["key"] != _POINTS_KEY:
        return None
    try:
        # From JSON text, so that its lists count as the tuples of the model.
        return PointSet.model_validate_json(json.dumps(entry["value"]))
    except ValidationError as error:
        raise CalibrationError(f"{where}: not a valid PointSet: {first_problem(error)}") from error


async def live_points(bus_config: BusConfig, seconds: float, on_time: Callable[[float, int], None]) -> list[PointSet]:
    """Return the point sets that a running rig publishes.

    Args:
        bus_config: how to reach it.
        seconds: how long to listen.
        on_time: is told the seconds since the start and the number of point sets so far.

    Raises:
        BusError: no router, or nothing was published.
    """
    points: list[PointSet] = []
    began = time.monotonic()

    async def listen(bus: Bus) -> None:
        async for _, point_set in bus.events(_POINTS_KEY).messages(PointSet):
            points.append(point_set)

    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus, listening(listen(bus)) as (task,):
        while (passed := time.monotonic() - began) < seconds and not task.done():
            on_time(passed, len(points))
            await asyncio.sleep(0.1)
    if not points:
        raise BusError(
            f"nothing came on {_POINTS_KEY} within {seconds:g} s; is the rig running and started "
            "(`rhot up`, `rhot start`, `rhot status`)?"
        )
    return points


FEWEST_SAMPLES: Final = 60
_SMALLEST_SIGMA_M: Final = 0.0003
"""Points are not believed to be better than this, whatever they say."""
_NOWHERE: Final = np.full(3, np.nan)


@dataclass(frozen=True, slots=True)
class HandSamples:
    """Markers of one hand at N moments, rig frame, metres; only what was measured at that moment.

    Attributes:
        t_ns: (N,) rig clock.
        base: (N, 3) centre of the base marker.
        corners: (N, 4, 3) of its patch in cyclic order; NaN = not seen.
        tips: (N, 5, 3) fingertip markers; NaN rows = not seen.
        sigma_m: typical standard deviation of a tip, metres (root of the sum of three variances), as published.
        began_ns: rig clock at the first point set, also where it showed no base.
    """

    t_ns: NDArray[np.int64]
    base: FloatArray
    corners: FloatArray
    tips: FloatArray
    sigma_m: float
    began_ns: int

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def seconds(self) -> FloatArray:
        """Times (N,) since the first point set."""
        return np.asarray((self.t_ns - self.began_ns) * 1e-9)

    @property
    def has_corners(self) -> bool:
        """Whether the patch's corners are seen often enough to tell how the palm is turned."""
        return len(self) > 0 and float(np.isfinite(self.corners).all(axis=(1, 2)).mean()) >= 0.5

    def at(self, index: NDArray[np.intp]) -> HandSamples:
        """Return some of the samples."""
        return HandSamples(
            self.t_ns[index], self.base[index], self.corners[index], self.tips[index], self.sigma_m, self.began_ns
        )


def read_samples(points: Iterable[PointSet], parameters: HandParameters) -> HandSamples:
    """Return the samples of a hand in which its base marker was measured.

    Raises:
        CalibrationError: too few of them; says what to do.
    """
    base_name = parameters.base
    times, bases, corners, tips, sigmas = [], [], [], [], []
    sets, began_ns = 0, 0
    for one in points:
        sets += 1
        began_ns = one.t_ns if sets == 1 else began_ns
        base = one.points.get(base_name)
        if base is None or base.state != "measured":
            continue
        times.append(one.t_ns)
        bases.append(base.position)
        corners.append(np.full((4, 3), np.nan) if base.corners is None else np.array(base.corners))
        tips.append([_measured(one.points.get(parameters.caps.get(finger, ""))) for finger in FINGERS])
        sigmas.append(base.sigma)
    if len(times) < FEWEST_SAMPLES:
        what = f"{base_name} was never seen" if not times else f"{base_name} was measured in only {len(times)} samples"
        raise CalibrationError(
            f"{what} ({sets} point sets in all), at least {FEWEST_SAMPLES} are needed; record 20 s or more with the "
            f"{parameters.side} hand in view of two cameras, and check with `rhot doctor` that the rig tracks"
        )
    sigma_m = max(float(np.median(sigmas)), _SMALLEST_SIGMA_M)
    arrays = np.array(times), np.array(bases), np.array(corners), np.array(tips)
    samples = _without_spikes(HandSamples(*arrays, sigma_m, began_ns))
    return samples.at(np.flatnonzero(np.isfinite(samples.base).all(axis=1)))


def _measured(point: Point | None) -> FloatArray:
    return np.array(point.position) if point is not None and point.state == "measured" else _NOWHERE


def _without_spikes(samples: HandSamples) -> HandSamples:
    """Return the samples without positions that lie far from both the sample before and the one after."""
    points = np.concatenate([samples.tips, samples.base[:, None]], axis=1)
    middle = np.median(np.stack([points[:-2], points[1:-1], points[2:]]), axis=0)
    spike_m = 0.008
    spike = np.linalg.norm(points[1:-1] - middle, axis=-1) > spike_m
    points[1:-1][spike] = np.nan
    return HandSamples(samples.t_ns, points[:, 5], samples.corners, points[:, :5], samples.sigma_m, samples.began_ns)
