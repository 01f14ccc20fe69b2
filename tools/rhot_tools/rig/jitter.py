"""How much markers jitter while the hand rests: in the pictures and in space (the thesis's figure 6.7).

No hand is ever quite still, and its motion is no jitter. A stretch of `_STRETCH` views counts where a line through it
leaves nothing but noise, which does not follow from view to view: with the differences d of successive residuals r, von
Neumann's ratio (Annals of Mathematical Statistics 12(4), 1941)

    η = Σ d² (n − 1)⁻¹ / Σ r² (n − 2)⁻¹

is 2 ± 2/√n for white noise, and less where the hand moves along a curve. In pictures jitter follows from how far each
view is from the middle of its neighbours: x_(k-1) − 2 x_k + x_(k+1) has six times the noise's variance and no motion to
speak of. Points of the same time are filtered, so that they follow from each other even at rest; of them it is the
deviation from a line, in stretches that are stiller yet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.report.svg import Bar, bar_plot
from rhot_tools.measures.rows import Row, Section
from rhot_tools.measures.streams import REST_PX
from rhot_tools.rig.heard import Heard
from rhot_tools.rig.statistics import Figure, figure_row, spread_of_stretches, truth_row

TimeArray = np.ndarray[tuple[int], np.dtype[np.int64]]
Span = tuple[int, int]
"""First and last time of a stretch, ns."""

THESIS_PX: Final = "thesis: 2–5 px"
_STRETCH: Final = 30
_LEAST_IN_SPAN: Final = 12
_STILL: Final = 4.0
_STILLER: Final = 2.0
"""How many √n the ratio may be below 2. Noise alone is two deviations below once in fifty stretches, one in six."""
_GAP: Final = 2.0
"""A stretch takes at most so many times as long as one without lost frames."""
_MM: Final = 1e3


@dataclass(frozen=True, slots=True)
class Jitter:
    """Standard deviations of markers at rest.

    Attributes:
        pixels: camera to marker to the deviation of (u, v) together, pixels.
        sideways, depth: marker to the deviation across and along the first camera's view, metres.
        off_truth: marker to (sideways, depth) about what is true at each moment, metres; only of a simulated rig.
        off_pixels: camera to marker to the deviation about the true projection, pixels; only of a simulated rig.
        rested: camera to the share of its stretches in which the marker that rested most was at rest.
    """

    pixels: Mapping[str, Mapping[str, Figure]]
    sideways: Mapping[str, Figure]
    depth: Mapping[str, Figure]
    off_truth: Mapping[str, tuple[float, float]]
    off_pixels: Mapping[str, Mapping[str, float]]
    rested: Mapping[str, float]


def still_jitter(heard: Heard, cameras: Mapping[str, CameraModel] | None = None) -> Jitter:
    """Return the jitter of all markers.

    Args:
        heard: while a hand was held still, or with stretches of rest in it.
        cameras: as they truly stand, of a simulated rig.
    """
    views = _views(heard)
    pixels: dict[str, dict[str, Figure]] = {}
    off_pixels: dict[str, dict[str, float]] = {}
    rested: dict[str, float] = {}
    spans: dict[str, dict[str, list[Span]]] = {}
    for camera, markers in views.items():
        rested[camera] = 0.0
        for name, (t_ns, uv) in markers.items():
            stretches = [slice(begin, begin + _STRETCH) for begin in range(0, len(uv) - _STRETCH + 1, _STRETCH)]
            at_rest = [each for each in stretches if _rests(t_ns[each], uv[each], _STILL)]
            rested[camera] = max(rested[camera], len(at_rest) / max(len(stretches), 1))
            if not at_rest:
                continue
            pixels.setdefault(camera, {})[name] = spread_of_stretches([_bends(uv[each]) for each in at_rest])
            spans.setdefault(name, {})[camera] = [(int(t_ns[each][0]), int(t_ns[each][-1])) for each in at_rest]
            true = _true_places(heard, name, t_ns)
            if cameras is not None and true is not None:
                off = uv - cameras[camera].project(np.nan_to_num(true))
                off[~np.isfinite(true[:, 0])] = np.nan
                off_pixels.setdefault(camera, {})[name] = _spread_off(t_ns, off, spans[name][camera], bends=True)
    sideways, depth, off_truth = {}, {}, {}
    for name, (t_ns, xyz) in _places(heard).items():
        still = _still_in_every_view(spans.get(name, {}), {camera: of.get(name) for camera, of in views.items()})
        chosen = [_within(t_ns, span) for span in still]
        pieces = [_about_line(t_ns[each], xyz[each]) for each in chosen if each.sum() >= _LEAST_IN_SPAN]
        if not pieces:
            continue
        sideways[name] = spread_of_stretches([piece[:, :2] for piece in pieces])
        depth[name] = spread_of_stretches([piece[:, 2:] for piece in pieces])
        true = _true_places(heard, name, t_ns)
        if true is not None:
            off = xyz - true
            off_truth[name] = (_spread_off(t_ns, off[:, :2], still), _spread_off(t_ns, off[:, 2:], still))
    return Jitter(pixels, sideways, depth, off_truth, off_pixels, rested)


def jitter_sections(jitter: Jitter) -> list[Section]:
    """Return the tables, compared with the truth where it is known; of a hand that never rested, that alone."""
    rested = Section("At rest", tuple(_rested_row(*each) for each in jitter.rested.items()))
    sections = [
        Section(
            f"Jitter in the pictures of camera {camera}",
            tuple(figure_row(name, figure, "px", peer=THESIS_PX) for name, figure in markers.items()),
        )
        for camera, markers in jitter.pixels.items()
    ]
    rows: list[Row] = []
    for name in jitter.sideways:
        rows.append(figure_row(f"{name}, sideways", jitter.sideways[name].scaled(_MM), "mm"))
        rows.append(figure_row(f"{name}, in depth", jitter.depth[name].scaled(_MM), "mm"))
    sections += [rested, *([Section("Jitter in space", tuple(rows))] if rows else [])]
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
    """Return bar charts as in the thesis's figure 6.7, grouped by marker, in pixels and in millimetres."""
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


def _rested_row(camera: str, share: float) -> Row:
    note = f"stretches of {_STRETCH} views in which a marker did not move"
    if not share:
        note += "; without any, the jitter is unknown: rest the hand on something (simulated: rhot sim --motion still)"
    return Row(f"{camera}, at rest", 100.0 * share, "%", note=note)


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


def _places(heard: Heard) -> dict[str, tuple[TimeArray, FloatArray]]:
    """Return times (N,) and measured positions (N, 3), metres, by marker."""
    found: dict[str, list[tuple[int, float, float, float]]] = {}
    for points in heard.points:
        for name, point in points.points.items():
            if point.state == "measured":
                found.setdefault(name, []).append((points.t_ns, *point.position))
    return {
        name: (np.array([row[0] for row in rows], dtype=np.int64), np.array([row[1:] for row in rows]))
        for name, rows in sorted(found.items())
    }


def _about_line(t_ns: TimeArray, values: FloatArray) -> FloatArray:
    """Return the residuals (N, D) of values about a line each over time, grown to have the noise's own variance."""
    t = (t_ns - t_ns.mean()) / max(float(np.ptp(t_ns)), 1.0)
    centred = values - values.mean(axis=0)
    residuals = centred - np.outer(t, t @ centred) / max(float(t @ t), 1e-12)
    count = len(values)
    found: FloatArray = residuals * np.sqrt(count / (count - 2))
    return found


def _bends(uv: FloatArray) -> FloatArray:
    """Return how far (N − 2, 2) views are from the middle of their neighbours, shrunk to have one view's variance."""
    found: FloatArray = np.diff(uv, 2, axis=0) / np.sqrt(6.0)
    return found


def _rests(t_ns: TimeArray, uv: FloatArray, slack: float) -> bool:
    """Return whether views (N, 2), pixels, move along a line at most, and by no more than `REST_PX`."""
    usual_ns = float(np.median(np.diff(t_ns)))
    if t_ns[-1] - t_ns[0] > _GAP * usual_ns * (len(t_ns) - 1) or np.ptp(uv, axis=0).max() > REST_PX:
        return False
    residuals = _about_line(t_ns, uv)
    variance = (residuals**2).mean(axis=0)
    steps = np.diff(residuals, axis=0)
    ratio = (steps**2).mean(axis=0) / np.maximum(variance, 1e-30)
    return bool((ratio[variance > 0.0] >= 2.0 - slack / np.sqrt(len(uv))).all())


def _still_in_every_view(
    spans: Mapping[str, Sequence[Span]], views: Mapping[str, tuple[TimeArray, FloatArray] | None]
) -> list[Span]:
    """Return the stretches of the first camera that each camera which sees the marker finds stiller than still."""
    if not spans:
        return []
    return [
        span
        for span in next(iter(spans.values()))
        if all(
            inside.sum() >= _LEAST_IN_SPAN and _rests(t_ns[inside], uv[inside], _STILLER)
            for t_ns, uv in filter(None, views.values())
            for inside in [_within(t_ns, span)]
        )
    ]


def _within(t_ns: TimeArray, span: Span) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = (span[0] <= t_ns) & (t_ns <= span[1])
    return inside


def _spread_off(t_ns: TimeArray, off: FloatArray, spans: Sequence[Span], *, bends: bool = False) -> float:
    """Return the jitter of errors (N, D) in stretches, about lines or by bends; NaN where no truth is known."""
    pieces = []
    for span in spans:
        inside = _within(t_ns, span) & np.isfinite(off[:, 0])
        if inside.sum() >= _LEAST_IN_SPAN:
            pieces.append(_bends(off[inside]) if bends else _about_line(t_ns[inside], off[inside]))
    return spread_of_stretches(pieces).value if pieces else float("nan")


def _bar(figure: Figure) -> Bar:
    return Bar(figure.value, figure.low, figure.high)


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
