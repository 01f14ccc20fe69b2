"""One rig of the family through the tracker's own cores, live and smoothed, and through the references."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rhot.messages import HandPose, Message, PointSet
from rhot.offline import track, track_smoothly
from rhot_bench.motion.errors import HandErrors, PointErrors, coverage, hand_errors, point_errors
from rhot_bench.motion.references.plain_ekf import plain_ekf
from rhot_bench.motion.references.spline_reference import spline_reference, views_of
from rhot_bench.motion.tracks import MARKERS, MarkerKind, Tracks, make_tracks
from rhot_tools.measures.points import Estimates, estimates_of


@dataclass(frozen=True, slots=True)
class Stratum:
    """Rigs of the family that have something in common.

    Attributes:
        name: for people.
        rate_hz, noise_px: instead of the drawn ones; None = as drawn.
        live_mm: target of a causal tracker, median and p95, tips in two views; None = no target.
    """

    name: str
    rate_hz: float | None = None
    noise_px: float | None = None
    live_mm: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Job:
    """One rig to run.

    Attributes:
        seed: of the rig, the clip and the hand.
        data: folder with the recorded hands.
        seconds: of the clip.
        strata: at which to run it.
        markers: `caps`, `bands` or `points`.
    """

    seed: int
    data: Path
    seconds: float
    strata: tuple[Stratum, ...]
    markers: MarkerKind = "caps"


@dataclass(frozen=True, slots=True)
class RigResult:
    """What became of one rig.

    Attributes:
        seed: of the rig.
        about: rig and clip in one line.
        points: by method: `live` and `smooth` of the tracker, `ekf` and `spline` of the references.
        hands: of `live` and `smooth`.
        coverage: by method.
    """

    seed: int
    about: str
    points: dict[str, PointErrors]
    hands: dict[str, HandErrors]
    coverage: dict[str, float]


def run_job(job: Job) -> list[RigResult]:
    """Make one rig's tracks and run everything on them, at each stratum."""
    results = []
    with tempfile.TemporaryDirectory(prefix="rhot-motion-") as folder:
        for number, stratum in enumerate(job.strata):
            tracks = make_tracks(
                job.seed,
                job.data,
                Path(folder) / f"rig{number}",
                seconds=job.seconds,
                rate_hz=stratum.rate_hz,
                noise_px=stratum.noise_px,
                markers=job.markers,
            )
            results.append(judge(tracks))
    return results


def judge(tracks: Tracks) -> RigResult:
    """Run the tracker's cores and the references on one rig's tracks."""
    live = tracked(track(tracks.rig, iter(tracks.frames)))
    smooth = tracked(track_smoothly(tracks.rig, iter(tracks.frames)))
    views = views_of(tracks.frames, tracks.rig)
    found = {
        "live": live[0],
        "smooth": smooth[0],
        "ekf": plain_ekf(views, len(tracks.frames), len(MARKERS)),
        "spline": spline_reference(views, len(MARKERS)),
    }
    return RigResult(
        tracks.seed,
        f"{tracks.name}: {tracks.draw.describe()}",
        {method: point_errors(tracks, one) for method, one in found.items()},
        {"live": hand_errors(tracks, live[1]), "smooth": hand_errors(tracks, smooth[1])},
        {method: coverage(tracks, one) for method, one in found.items()},
    )


def tracked(messages: Iterable[tuple[str, Message]]) -> tuple[Estimates, list[HandPose]]:
    """Return points and hands among what a tracker publishes."""
    sets: list[PointSet] = []
    poses: list[HandPose] = []
    for _, message in messages:
        if isinstance(message, PointSet):
            sets.append(message)
        elif isinstance(message, HandPose):
            poses.append(message)
    return estimates_of(sets, MARKERS), poses
