"""How much markers jitter while the hand rests: in the pictures and in space (the thesis's figure 6.7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.report.svg import Bar, bar_plot
from rhot_bench.measures.rows import Row, Section
from rhot_bench.measures.streams import REST_FRAMES, REST_PX
from rhot_bench.rig.heard import Heard
from rhot_bench.rig.rows import figure_row, truth_row
from rhot_bench.rig.statistics import Figure, deviation, mean_of_independent

TimeArray = np.ndarray[tuple[int], np.dtype[np.int64]]

THESIS_PX: Final = "thesis: 2–5 px"
_LEAST_SAMPLES: Final = 30
_MM: Final = 1e3


@dataclass(frozen=True, slots=True)
class Jitter:
    """Standard deviations of markers at rest.

    Attributes:
        pixels: camera to marker to the deviation of (u, v) together, pixels.
        sideways, depth: marker to the deviation across and along the first camera's view, metres.
        off_truth: marker to (sideways, depth) about what is true at each moment, metres; only of a simulated rig.
        off_pixels: camera to marker to the deviation about the true projection, pixels; only of a simulated rig.
        wandered: camera to how far a marker wandered at most, pixels: between the means of whole seconds.
    """

    pixels: Mapping[str, Mapping[str, Figure]]
    sideways: Mapping[str, Figure]
    depth: Mapping[str, Figure]
    off_truth: Mapping[str, tuple[float, float]]
    off_pixels: Mapping[str, Mapping[str, float]]
    wandered: Mapping[str, float]

    @property
    def moved(self) -> bool:
        """Whether the hand moved: then the deviations are its motion and no jitter."""
        return max(self.wandered.values(), default=0.0) > REST_PX


def still_jitter(heard: Heard, *, rests_only: bool, cameras: Mapping[str, CameraModel] | None = None) -> Jitter:
    """Return the jitter of all markers.

    Args:
        heard: while a hand was held still, or with stretches of rest in it.
        cameras: as they truly stand, of a simulated rig.
        rests_only: judge only stretches of half a second in which a view moves by no more than two pixels; a hand that
            is held still for a minute is judged as a whole, so that slow swaying counts.
    """
    spread = _rests if rests_only else deviation
    views = _views(heard)
    pixels = {
        camera: {name: spread(uv) for name, (_, uv) in markers.items() if len(uv) >= _LEAST_SAMPLES}
        for camera, markers in views.items()
    }
    wandered = {
        camera: max((_wander_px(t_ns, uv) for t_ns, uv in markers.values()), default=0.0)
        for camera, markers in views.items()
        if not rests_only
    }
    off_pixels = {
        camera: {
            name: float(np.sqrt(off.var(axis=0, ddof=1).sum()))
            for name, (t_ns, uv) in markers.items()
            if len(off := _off_projection(heard, cameras[camera], name, t_ns, uv)) >= _LEAST_SAMPLES
        }
        for camera, markers in views.items()
        if cameras is not None and not rests_only
    }
    places: dict[str, list[tuple[int, float, float, float]]] = {}
    for points in heard.points:
        for name, point in points.points.items():
            if point.state == "measured":
                places.setdefault(name, []).append((points.t_ns, *point.position))
    sideways, depth, off_truth = {}, {}, {}
    for name, rows in sorted(places.items()):
        if len(rows) < _LEAST_SAMPLES:
            continue
        xyz = np.array([row[1:] for row in rows])
        if rests_only:
            pieces = _resting(xyz, heard, name)
            sideways[name], depth[name] = _pooled(pieces[..., :2]), _pooled(pieces[..., 2:])
        else:
            sideways[name], depth[name] = deviation(xyz[:, :2]), deviation(xyz[:, 2])
        true = _true_places(heard, name, np.array([row[0] for row in rows], dtype=np.int64))
        if true is not None:
            off = (xyz - true)[np.isfinite(true[:, 0])]
            off_truth[name] = (float(np.sqrt(off[:, :2].var(axis=0, ddof=1).sum())), float(off[:, 2].std(ddof=1)))
    return Jitter(pixels, sideways, depth, off_truth, off_pixels, wandered)


def jitter_sections(jitter: Jitter) -> list[Section]:
    """Return the tables, compared with the truth where it is known; of a hand that moved, only by how much."""
    wandered = tuple(_wander_row(*each) for each in jitter.wandered.items())
    still = [Section("Was it still?", wandered)] if wandered else []
    if jitter.moved:
        return still
    sections = [
        Section(
            f"Jitter in the pictures of camera {camera}",
            tuple(figure_row(name, figure, "px", peer=THESIS_PX) for name, figure in markers.items()),
        )
        for camera, markers in jitter.pixels.items()
        if markers
    ]
    sections += still
    rows: list[Row] = []
    for name in jitter.sideways:
        rows.append(figure_row(f"{name}, sideways", jitter.sideways[name].scaled(_MM), "mm"))
        rows.append(figure_row(f"{name}, in depth", jitter.depth[name].scaled(_MM), "mm"))
    sections += [Section("Jitter in space", tuple(rows))] if rows else []
    beside = [
        truth_row(f"{name} in the pictures of {camera}", jitter.pixels[camera][name], true, "px")
        for camera, off_px in jitter.off_pixels.items()
        for name, true in off_px.items()
    ]
    beside += [
        truth_row(f"{name}, {axis}", figure[name].scaled(_MM), _MM * true, "mm")
        for name, off in jitter.off_truth.items()
        for axis, figure, true in (("sideways", jitter.sideways, off[0]), ("in depth", jitter.depth, off[1]))
    ]
    if beside:
        sections.append(Section("Jitter beside the simulator's truth (1: within its interval)", tuple(beside)))
    return sections


def jitter_plots(jitter: Jitter) -> list[str]:
    """Return bar charts as in the thesis's figure 6.7, grouped by marker, in pixels and in millimetres.

    There are none of a hand that moved.
    """
    if jitter.moved:
        return []
    names = sorted({name for markers in jitter.pixels.values() for name in markers})
    in_pixels = {
        name: {camera: _bar(markers[name]) for camera, markers in jitter.pixels.items() if name in markers}
        for name in names
    }
    in_space = {
        name: {"sideways": _bar(jitter.sideways[name].scaled(_MM)), "in depth": _bar(jitter.depth[name].scaled(_MM))}
        for name in jitter.sideways
    }
    plots = [bar_plot("Jitter of each marker in the pictures", "standard deviation [px]", in_pixels)] if names else []
    return plots + ([bar_plot("Jitter of each marker in space", "deviation [mm]", in_space)] if in_space else [])


def _wander_row(camera: str, wandered_px: float) -> Row:
    note = "between the means of whole seconds"
    if wandered_px > REST_PX:
        note += "; the hand moved, so its jitter is unknown: rest it on something (simulated: rhot sim --motion still)"
    return Row(f"{camera}, a marker wandered by at most", wandered_px, "px", most=REST_PX, note=note)


def _views(heard: Heard) -> dict[str, dict[str, tuple[TimeArray, FloatArray]]]:
    """Return times (N,), rig clock, and views (N, 2), pixels, by camera and marker."""
    found: dict[str, dict[str, list[tuple[int, float, float]]]] = {}
    for frame in heard.frames:
        for name, marker in frame.markers.items():
            t_ns = frame.t_ns if marker.t_ns is None else marker.t_ns
            found.setdefault(frame.camera, {}).setdefault(name, []).append((t_ns, marker.u, marker.v))
    return {
        camera: {
            name: (np.array([row[0] for row in rows], dtype=np.int64), np.array([row[1:] for row in rows]))
            for name, rows in sorted(markers.items())
        }
        for camera, markers in sorted(found.items())
    }


def _wander_px(t_ns: TimeArray, uv: FloatArray) -> float:
    """Return how far apart the means of whole seconds lie at most; seconds with few views tell nothing."""
    second = (t_ns - t_ns[0]) // 1_000_000_000
    means = np.array([uv[second == one].mean(axis=0) for one in np.unique(second) if (second == one).sum() >= 5])
    return float(np.ptp(means, axis=0).max()) if len(means) > 1 else 0.0


def _off_projection(heard: Heard, camera: CameraModel, name: str, t_ns: TimeArray, uv: FloatArray) -> FloatArray:
    """Return how far views (N, 2) lie from where the marker truly was, pixels, for those within the truth's time."""
    true = _true_places(heard, name, t_ns)
    if true is None:
        return np.empty((0, 2))
    known = np.isfinite(true[:, 0])
    off: FloatArray = uv[known] - camera.project(true[known])
    return off


def _bar(figure: Figure) -> Bar:
    return Bar(figure.value, figure.low, figure.high)


def _rests(uv: FloatArray) -> Figure:
    begins = _rest_begins(uv)
    return _pooled(
        np.array([uv[begin : begin + REST_FRAMES] for begin in begins]).reshape(-1, REST_FRAMES, uv.shape[1])
    )


def _rest_begins(uv: FloatArray) -> list[int]:
    if len(uv) < REST_FRAMES:
        return []
    windows = sliding_window_view(uv, REST_FRAMES, axis=0)
    still = (windows.max(axis=-1) - windows.min(axis=-1) <= REST_PX).all(axis=1)
    begins: list[int] = []
    for begin in np.flatnonzero(still).tolist():
        if not begins or begin >= begins[-1] + REST_FRAMES:
            begins.append(begin)
    return begins


def _pooled(pieces: FloatArray) -> Figure:
    """Return the deviation within pieces (K, N, D), each about its own mean; pieces are independent of one another."""
    if not len(pieces):
        return Figure(float("nan"), float("nan"), float("nan"), 0.0, 0)
    variance = mean_of_independent(pieces.var(axis=1, ddof=1).sum(axis=1))
    low, high = (float(np.sqrt(max(end, 0.0))) for end in (variance.low, variance.high))
    return Figure(float(np.sqrt(variance.value)), low, high, variance.independent, len(pieces) * pieces.shape[1])


def _resting(xyz: FloatArray, heard: Heard, name: str) -> FloatArray:
    """Return stretches (K, N, 3) of points whose span is what rest allows: two pixels at the marker's own depth."""
    seen = [frame for frame in heard.frames if name in frame.markers]
    reach = REST_PX / (0.83 * max((frame.width for frame in seen), default=640)) * float(np.median(xyz[:, 2]))
    windows = (
        sliding_window_view(xyz, REST_FRAMES, axis=0) if len(xyz) >= REST_FRAMES else np.empty((0, 3, REST_FRAMES))
    )
    still = ((windows.max(axis=-1) - windows.min(axis=-1))[:, :2] <= reach).all(axis=1)
    chosen: list[int] = []
    for begin in np.flatnonzero(still).tolist():
        if not chosen or begin >= chosen[-1] + REST_FRAMES:
            chosen.append(begin)
    return np.array([xyz[begin : begin + REST_FRAMES] for begin in chosen]).reshape(-1, REST_FRAMES, 3)


def _true_places(heard: Heard, name: str, t_ns: TimeArray) -> FloatArray | None:
    """Return where a marker truly was (N, 3) at times, between the moments that the truth names; None without truth."""
    known = [(each.t_ns, each.points[name]) for each in heard.truth if name in each.points]
    if len(known) < 2:
        return None
    times = np.array([t for t, _ in known], dtype=np.int64)
    wanted = (t_ns - times[0]).astype(np.float64)
    places = np.array([place for _, place in known])
    since = (times - times[0]).astype(np.float64)
    return np.stack([np.interp(wanted, since, axis, np.nan, np.nan) for axis in places.T], axis=1)
