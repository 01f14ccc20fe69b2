"""Disparity against measured distance, and the laws through it (the thesis's table 10.1)."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.special import stdtrit

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame, Truth
from rhot.quality import pair_epipolar_p95_px
from rhot.report.svg import line_plot
from rhot.rig import Rig
from rhot.rig.cameras import camera_model
from rhot_calibration.depth.fit import PhysicalLaw, PowerLaw, fit_physical_law, fit_power_law, relative_rms
from rhot_fusion.filter.systematic import CALIBRATION_DOUBT, CALIBRATION_PX
from rhot_tools.measures.rows import Row, Section
from rhot_tools.rig.statistics import COVERAGE, Figure, figure_row, mean, truth_row

_CM: Final = 100.0
_LEAST_SAMPLES: Final = 10
_SIGMAS: Final = 2.0
"""Standard deviations within which 95 of 100 normal samples lie."""
_LONGEST_GAP_S: Final = 0.1
_DISTANCES: Final = 12
"""Stretches into which a simulated hand's way towards and away from the cameras is divided."""


@dataclass(frozen=True, slots=True)
class DepthRow:
    """One distance.

    Attributes:
        distance_m: measured with a ruler along the first camera's view.
        disparity_px: mean over the time that the marker was held there; the interval includes the ruler's, and the
            calibration's.
        off_px: how much of that interval is the ruler's and the calibration's: no time makes it less, and all distances
            may be off alike.
    """

    distance_m: float
    disparity_px: Figure
    off_px: float = 0.0


def printed_table() -> tuple[FloatArray, FloatArray]:
    """Return distances (17,), metres, and disparities (17,), pixels, as the thesis prints them in table 10.1."""
    text = files("rhot_bench.thesis").joinpath("table_10_1.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    distances = np.array([float(row["distance_cm"]) for row in rows]) / _CM
    return distances, np.array([float(row["disparity_px"]) for row in rows])


def disparities(rig: Rig, frames: Sequence[MarkerFrame], marker: str) -> tuple[FloatArray, FloatArray]:
    """Return times (N,), nanoseconds, and disparities (N,), pixels, of a marker in the first two cameras.

    As `fusion` has them: undistorted, the second camera turned into the first one's orientation, u_left − u_right. The
    cameras are not in step: the second one's view is interpolated to the first one's time.

    Raises:
        ConfigError: the rig has one camera.
    """
    if len(rig.cameras) < 2:
        raise ConfigError(f"{rig.path / 'rig.toml'}: a disparity needs two cameras, it has one")
    names = list(rig.cameras)[:2]
    first, second = (camera_model(rig.cameras[name]) for name in names)
    sign = 1.0 if float(first.to_camera(second.center[None])[0, 0]) > 0.0 else -1.0
    (t_first, x_first), (t_second, x_second) = (
        _views(camera, [each for each in frames if each.camera == name], marker, R)
        for name, camera, R in zip(
            names, (first, second), (np.eye(3), first.R_camera_rig @ second.R_camera_rig.T), strict=True
        )
    )
    if len(t_first) < 2 or len(t_second) < 2:
        return np.empty(0), np.empty(0)
    after = np.clip(np.searchsorted(t_second, t_first), 1, len(t_second) - 1)
    joined = (
        (t_second[after] - t_second[after - 1] <= 1e9 * _LONGEST_GAP_S)
        & (t_first >= t_second[after - 1])
        & (t_first <= t_second[after])
    )
    other = np.interp(t_first, t_second, x_second)
    return t_first[joined], (sign * float(first.K[0, 0]) * (x_first - other))[joined]


def calibration_px(rig: Rig) -> float:
    """Return what the cameras' calibration may put a disparity off, pixels: what `fusion` takes it for."""
    names = list(rig.cameras)[:2]
    stated = pair_epipolar_p95_px(rig.quality, *names) if len(names) == 2 else None
    return CALIBRATION_DOUBT * (stated or CALIBRATION_PX)


def row_at(distance_m: float, disparity_px: FloatArray, ruler_m: float, calibration_px: float = 0.0) -> DepthRow:
    """Return a row of a marker held at a distance.

    Args:
        distance_m: as measured.
        disparity_px: (N,) of all frames.
        ruler_m: what the distance may be off.
        calibration_px: what the calibration may put a disparity off.

    Raises:
        ConfigError: both cameras saw it too rarely.
    """
    if len(disparity_px) < _LEAST_SAMPLES:
        raise ConfigError(
            f"at {_CM * distance_m:g} cm both cameras saw the marker {len(disparity_px)} times, {_LEAST_SAMPLES} are "
            "the least; is it in both pictures (rhot/preview, or the tab Pictures)?"
        )
    found = mean(disparity_px)
    if np.isnan(found.low):
        # Too few independent samples: as unsure as a single one, which is more than the mean can be.
        one = _SIGMAS * float(disparity_px.std(ddof=1))
        found = replace(found, low=found.value - one, high=found.value + one)
    # A distance that is off by δ is a disparity that is off by d · δ / D.
    by = abs(found.value) * ruler_m / distance_m + calibration_px
    return DepthRow(distance_m, replace(found, low=found.low - by, high=found.high + by), by)


def rows_by_truth(rig: Rig, frames: Sequence[MarkerFrame], truth: Sequence[Truth], marker: str) -> list[DepthRow]:
    """Return rows whose ruler is the simulator's exact truth: the moving hand's way in depth, in equal stretches.

    Each sample is brought to the middle of its stretch by what the truth says of the difference, so that a stretch may
    be wide; d · D is nearly constant.
    """
    t_ns, disparity = disparities(rig, frames, marker)
    known = [(each.t_ns, each.points[marker]) for each in truth if marker in each.points]
    if len(known) < 2 or not len(t_ns):
        return []
    camera = camera_model(next(iter(rig.cameras.values())))
    depth_known = camera.to_camera(np.array([place for _, place in known]))[:, 2]
    depth = np.interp(t_ns, np.array([t for t, _ in known], dtype=np.float64), depth_known, np.nan, np.nan)
    depth, disparity = depth[np.isfinite(depth)], disparity[np.isfinite(depth)]
    edges = np.linspace(depth.min(), depth.max() + 1e-9, _DISTANCES + 1)
    rows = []
    for low, high in pairwise(edges.tolist()):
        inside = (depth >= low) & (depth < high)
        if inside.sum() >= _LEAST_SAMPLES:
            middle = 0.5 * (low + high)
            rows.append(row_at(float(middle), disparity[inside] * depth[inside] / middle, 0.0, calibration_px(rig)))
    return rows


def power_law_figures(rows: Sequence[DepthRow]) -> tuple[PowerLaw, Figure, Figure]:
    """Return the power law D = k · d^z through rows, and k (centimetres) and z with their intervals.

    The law is a line through logarithms, so its intervals are those of linear regression (Student's t, n − 2), wider by
    what ruler and calibration may put it off.
    """
    distance, disparity = _columns(rows)
    law = fit_power_law(distance, disparity)
    x = np.log(disparity)
    off = abs(law.z) * np.array([row.off_px for row in rows]) / disparity
    of_log_k, of_z = _reaches(x, np.log(distance) - np.log(law.k) - law.z * x, off)
    count = len(rows)
    k = Figure(_CM * law.k, _CM * law.k * np.exp(-of_log_k), _CM * law.k * np.exp(of_log_k), count, count)
    return law, k, Figure(law.z, law.z - of_z, law.z + of_z, count, count)


def physical_law_figures(rows: Sequence[DepthRow]) -> tuple[PhysicalLaw, Figure, Figure]:
    """Return the physical law D = a / (d − o) through rows, and a (pixel metres) and o (pixels) with their intervals.

    Relative errors of depth are those of d · D, which by this law is the line a + o · D; see `power_law_figures`.
    """
    distance, disparity = _columns(rows)
    law, count = fit_physical_law(distance, disparity), len(rows)
    off = np.array([row.off_px for row in rows]) * distance
    of_a, of_o = _reaches(distance, disparity * distance - law.a - law.offset_px * distance, off)
    a = Figure(law.a, law.a - of_a, law.a + of_a, count, count)
    return law, a, Figure(law.offset_px, law.offset_px - of_o, law.offset_px + of_o, count, count)


def _reaches(x: FloatArray, residual: FloatArray, off: FloatArray) -> tuple[float, float]:
    """Return how far the constant and the slope of a line through points (N,) may be off.

    Args:
        x: of the points.
        residual: of the points from the line.
        off: how far each point may be off that its residual does not show: all alike, or each on its own.
    """
    count, from_middle = len(x), x - x.mean()
    square = float(from_middle @ from_middle)
    freedom = max(count - 2, 1)
    variance = float(residual @ residual) / freedom
    reach = float(stdtrit(freedom, 0.5 + 0.5 * COVERAGE))
    slope = from_middle / square
    constant = 1.0 / count - x.mean() * slope
    by_scatter = reach * np.sqrt(variance * np.array([float(constant @ constant), float(slope @ slope)]))
    by_off = [max(abs(float(weights @ off)), float(np.linalg.norm(weights * off))) for weights in (constant, slope)]
    return float(by_scatter[0] + by_off[0]), float(by_scatter[1] + by_off[1])


def depth_sections(rows: Sequence[DepthRow], true_fb: float | None = None) -> list[Section]:
    """Return the tables: each distance, and the laws beside the thesis's.

    Args:
        rows: in any order.
        true_fb: focal length times baseline of a simulated rig, pixel metres.
    """
    ordered = sorted(rows, key=lambda row: row.distance_m)
    distance, disparity = _columns(ordered)
    law, k, z = power_law_figures(ordered)
    physical, a, offset = physical_law_figures(ordered)
    printed = printed_table()
    theirs = fit_power_law(*printed)
    at = Section(
        "Disparity at each distance",
        tuple(
            figure_row(
                f"{_CM * row.distance_m:.1f} cm",
                row.disparity_px,
                "px",
                digits=4,
                note=f"the law says {_CM * float(law.depth_m(np.array([row.disparity_px.value]))[0]):.1f} cm",
            )
            for row in ordered
        ),
    )
    error = 100.0 * relative_rms(law, distance, disparity)
    laws = [
        figure_row("k of D[cm] = k · d^z", k, "", peer=f"thesis: {_CM * theirs.k:.1f}", digits=5),
        figure_row("z", z, "", peer=f"thesis: {theirs.z:.3f}", digits=4),
        Row(
            "relative depth error of this law",
            error,
            "%",
            peer=f"thesis: {100.0 * relative_rms(theirs, *printed):.2f} %",
        ),
        figure_row("a = f · B of D = a / (d − o)", a, "px m", digits=4),
        figure_row("o", offset, "px"),
        Row("relative depth error of that law", 100.0 * relative_rms(physical, distance, disparity), "%"),
    ]
    sections = [at, Section(f"Depth laws, rig.toml: depth_law = [{k.value:.1f}, {z.value:.4f}]", tuple(laws))]
    if true_fb is not None:
        checks = [
            truth_row(f"disparity at {_CM * row.distance_m:.1f} cm", row.disparity_px, true_fb / row.distance_m, "px")
            for row in ordered
        ]
        checks += [truth_row("k", k, _CM * true_fb, ""), truth_row("z", z, -1.0, "")]
        checks += [truth_row("a", a, true_fb, "px m"), truth_row("o", offset, 0.0, "px")]
        sections.append(_beside_truth(checks))
    return sections


def _beside_truth(checks: Sequence[Row]) -> Section:
    return Section("Disparity beside the simulator's truth (1: within its interval)", tuple(checks))


def depth_plot(rows: Sequence[DepthRow]) -> str:
    """Return distance over disparity, measured and as the thesis printed it."""
    distance, disparity = _columns(sorted(rows, key=lambda row: row.distance_m))
    law, _, _ = power_law_figures(rows)
    over = np.linspace(disparity.min(), disparity.max(), 100)
    printed_m, printed_px = printed_table()
    order = np.argsort(printed_px)
    lines: Mapping[str, tuple[FloatArray, FloatArray]] = {
        "here": (disparity[::-1], _CM * distance[::-1]),
        "law": (over, _CM * law.depth_m(over)),
        "thesis": (printed_px[order], _CM * printed_m[order]),
    }
    return line_plot("Distance over disparity", "disparity [px]", "distance [cm]", lines)


def _columns(rows: Sequence[DepthRow]) -> tuple[FloatArray, FloatArray]:
    return np.array([row.distance_m for row in rows]), np.array([row.disparity_px.value for row in rows])


def _views(
    camera: CameraModel, frames: Sequence[MarkerFrame], marker: str, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return times (N,), nanoseconds, ascending, and normalised x (N,) of a marker after rotating its rays by R."""
    seen = [(each.markers[marker], each.t_ns) for each in frames if marker in each.markers]
    if not seen:
        return np.empty(0), np.empty(0)
    t = np.array([found.t_ns or t_ns for found, t_ns in seen], dtype=np.float64)
    xy = camera.undistort(np.array([(found.u, found.v) for found, _ in seen]))
    rays = np.column_stack([xy, np.ones(len(xy))]) @ R.T
    order = np.argsort(t)
    x: FloatArray = rays[:, 0] / rays[:, 2]
    return t[order], x[order]
