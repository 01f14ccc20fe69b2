"""`rhot evaluate motion`: recorded hands before a family of random rigs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, Literal

import click
import numpy as np
from rich.console import Console

from rhot.arrays import BoolArray, FloatArray
from rhot.cli.options import FiniteRange, jobs_option
from rhot_bench.motion.errors import HandErrors, PointErrors, joined_hands, joined_points
from rhot_bench.motion.recordings import list_recordings
from rhot_bench.motion.run import Job, RigResult, Stratum, run_job
from rhot_bench.motion.tracks import MarkerKind
from rhot_bench.processes import each
from rhot_tools.measures.output import counted, json_option, show
from rhot_tools.measures.rows import Row, Section, check_output

# Errors of many rigs as rows of a table, beside the references and the targets.

_MM: Final = 1e3
_FAR_M: Final = 0.050
_CHI2_95: Final = 7.815
"""95 % of chi-square with three degrees of freedom."""
_OFFSET: Final = (
    "one constant offset per rig and marker removed (bone and line of sight): paint and calibration shift all alike"
)


# Targets but those of live tips, which depend on the stratum; lengths in millimetres.
_ONE_VIEW: Final = (8.0, 20.0)
_HIDDEN_SHORT: Final = (15.0, 40.0)
_HIDDEN_LONG_GRASP: Final = (25.0, 60.0)
"""Of the hand's tips: median and 95th percentile."""
_JOINTS: Final = 6.0
_JOINTS_GRASP: Final = 12.0
"""Mean of the 26 joints with all tips in two views, and in a grasp with two to five hidden."""
_STEP: Final = 10.0
"""Beyond true motion on re-appearance."""
_TWO_SIGMA: Final = (90.0, 99.0)
"""Share of errors within two stated sigma, percent."""
_START_TIMES: Final = 1.5
"""The first half second against the rest."""
_SPLINE_SHARE: Final = 0.9
"""Smoothed points against the spline on the same tracks."""


def stratum_sections(stratum: Stratum, results: Sequence[RigResult]) -> list[Section]:
    """Return the tables of one stratum: points live, points smoothed, the hand."""
    points = {method: joined_points([one.points[method] for one in results]) for method in results[0].points}
    cover = {method: 100.0 * float(np.nanmean([one.coverage[method] for one in results])) for method in points}
    hands = {method: joined_hands([one.hands[method] for one in results]) for method in results[0].hands}
    about = f"{stratum.name}, {len(results)} rigs"
    return [
        Section(f"Points live: {about}", _live_rows(points, cover, stratum)),
        Section(f"Points smoothed: {about}", _smooth_rows(points, cover)),
        Section(f"Hand: {about}", _hand_rows(hands)),
    ]


def _live_rows(points: dict[str, PointErrors], cover: dict[str, float], stratum: Stratum) -> tuple[Row, ...]:
    live, ekf = points["live"], points["ekf"]
    mine, other = _two_views(live), _two_views(ekf)
    rows: list[Row] = []
    for name, late, times in (("after 0.5 s", True, 1.0), ("first 0.5 s", False, _START_TIMES)):
        own, theirs = mine & ((live.age_s >= 0.5) == late), other & ((ekf.age_s >= 0.5) == late)
        limits = [limit * times for limit in stratum.live_mm] if stratum.live_mm else [None, None]
        rows += _spread(f"tips in two views, {name}", live, own, limits, ("plain EKF", ekf, theirs))
    beside = ("plain EKF", ekf, other & ekf.clear)
    rows += _spread("tips all but unhidden in two views", live, mine & live.clear, [None, None], beside)
    rows += _worst(live, mine, ("plain EKF", ekf, other))
    rows += _raw(live, mine, ("plain EKF", ekf, other))
    rows += _honesty(live, mine, ("plain EKF", ekf, other))
    rows.append(_coverage(cover["live"], "plain EKF", cover["ekf"]))
    one = (live.views == 1) & (live.marker < 5)
    rows += _spread("tips in one view, as published", live, one, [None, None], ("plain EKF", ekf, ekf.views == 1))
    rows += _false_points(live, ("plain EKF", ekf))
    return tuple(rows)


def _smooth_rows(points: dict[str, PointErrors], cover: dict[str, float]) -> tuple[Row, ...]:
    smooth, spline = points["smooth"], points["spline"]
    mine, other = _two_views(smooth), _two_views(spline)
    reached = [_at(spline.error_offset_m[other], share) for share in (50, 95)]
    limits = [round(_SPLINE_SHARE * value, 2) for value in reached]
    rows = _spread("tips in two views", smooth, mine, limits, ("spline", spline, other))
    beside = ("spline", spline, other & spline.clear)
    rows += _spread("tips all but unhidden in two views", smooth, mine & smooth.clear, [None, None], beside)
    rows += _worst(smooth, mine, ("spline", spline, other))
    rows += _raw(smooth, mine, ("spline", spline, other))
    rows += _honesty(smooth, mine, None)
    rows.append(_coverage(cover["smooth"], "spline", cover["spline"]))
    rows += _false_points(smooth, ("spline", spline))
    return tuple(rows)


def _hand_rows(hands: dict[str, HandErrors]) -> tuple[Row, ...]:
    rows: list[Row] = []
    for method, hand in hands.items():
        grasp = np.repeat(hand.grasps[:, None], 5, axis=1)
        hidden = hand.hidden_s > 0.0
        known = np.isfinite(hand.hidden_s)
        classes = (
            ("in two views", hand.views >= 2, (None, None)),
            ("in one view", hand.views == 1, _ONE_VIEW),
            ("hidden up to 0.5 s", hidden & (hand.hidden_s <= 0.5), _HIDDEN_SHORT),
            ("hidden longer, in a grasp", hidden & (hand.hidden_s > 0.5) & grasp, _HIDDEN_LONG_GRASP),
            ("hidden longer, free hand", hidden & (hand.hidden_s > 0.5) & ~grasp, (None, None)),
            ("never seen yet", ~known, (None, None)),
        )
        for name, chosen, limits in classes:
            errors = hand.tips_m[chosen] * _MM
            note = f"{method}, {name}: {errors.size} tips"
            rows += [
                Row(f"{method}, tips {name}, {label}", _at(errors, share, 1.0), "mm", most=limit, note=note)
                for (label, share), limit in zip((("median", 50), ("p95", 95)), limits, strict=True)
            ]
            shares = hand.tips_m[chosen] / hand.sigmas_m[chosen]
            rows += [
                Row(
                    f"{method}, tips {name}, within {sigmas} sigma",
                    _mean(np.where(shares < sigmas, 100.0, 0.0)),
                    "%",
                    note=note,
                )
                for sigmas in (1, 2)
            ]
        lost = (hidden | ~known).sum(axis=1)
        joints = hand.joints_m * _MM
        seen, held = (hand.views >= 2).all(axis=1), hand.grasps & (lost >= 2)
        rows += [
            Row(f"{method}, 26 joints, all tips in two views, mean", _mean(joints[seen]), "mm", most=_JOINTS),
            Row(
                f"{method}, 26 joints, two to five hidden in a grasp, mean",
                _mean(joints[held]),
                "mm",
                most=_JOINTS_GRASP,
            ),
            Row(f"{method}, 26 joints, at any time, mean", _mean(joints), "mm"),
        ]
        steps = hand.step_m[np.isfinite(hand.step_m)] * _MM
        note = "the largest step of a tip within 0.1 s of its re-appearance, less the true one"
        largest = float(steps.max()) if steps.size else float("nan")
        rows += [
            Row(f"{method}, step beyond true motion on re-appearance, p95", _at(steps, 95, 1.0), "mm", note=note),
            Row(f"{method}, the same, largest", largest, "mm", most=_STEP, note=note),
        ]
    return tuple(rows)


_Beside = tuple[str, PointErrors, BoolArray]


def _two_views(points: PointErrors) -> BoolArray:
    """Return which estimates are of tips, told as measured while two cameras or more see them."""
    chosen: BoolArray = points.measured & (points.views >= 2) & (points.marker < 5)
    return chosen


def _spread(
    name: str, points: PointErrors, chosen: BoolArray, limits: Sequence[float | None], beside: _Beside
) -> list[Row]:
    other, reference, theirs = beside
    return [
        Row(
            f"{name}, {label}",
            _at(points.error_offset_m[chosen], share),
            "mm",
            most=limit,
            peer=f"{other}: {_at(reference.error_offset_m[theirs & (reference.marker < 5)], share):.2f}",
            note=_OFFSET,
        )
        for (label, share), limit in zip((("median", 50), ("p95", 95)), limits, strict=True)
    ]


def _worst(points: PointErrors, chosen: BoolArray, beside: _Beside) -> list[Row]:
    other, reference, theirs = beside
    rows = []
    for label, share in (("median", 50), ("p95", 95)):
        values = [
            max((_at(p.error_offset_m[c & (p.rig == rig)], share) for rig in np.unique(p.rig[c])), default=float("nan"))
            for p, c in ((points, chosen), (reference, theirs))
        ]
        rows.append(Row(f"the worst rig's {label}", values[0], "mm", peer=f"{other}: {values[1]:.2f}", note=_OFFSET))
    return rows


def _raw(points: PointErrors, chosen: BoolArray, beside: _Beside) -> list[Row]:
    other, reference, theirs = beside
    return [
        Row(
            f"nothing removed, {label}",
            _at(points.error_m[chosen], share),
            "mm",
            peer=f"{other}: {_at(reference.error_m[theirs], share):.2f}",
        )
        for label, share in (("median", 50), ("p95", 95))
    ]


def _honesty(points: PointErrors, chosen: BoolArray, beside: _Beside | None) -> list[Row]:
    def shares(p: PointErrors, c: BoolArray) -> tuple[float, float, float, float]:
        ratio, nees = p.error_m[c] / p.sigma_m[c], p.nees[c]
        if not len(ratio):
            return (float("nan"),) * 4
        within = (100.0 * float((ratio <= 1.0).mean()), 100.0 * float((ratio <= 2.0).mean()))
        return *within, float(np.median(nees)) / 2.366, 100.0 * float((nees > _CHI2_95).mean())

    own = shares(points, chosen)
    other = shares(beside[1], beside[2]) if beside else None
    name = beside[0] if beside else ""
    least, most = _TWO_SIGMA
    note = "of what is stated as root of the summed variances; nothing removed; the target is 90 to 99 %"
    rows = (
        ("within one stated sigma", own[0], "%", None, None, note),
        ("within two stated sigma", own[1], "%", least, most, note),
        ("median NEES over that of chi-square", own[2], "", None, None, "1 = honest; three degrees of freedom"),
        ("NEES beyond 95 % of chi-square", own[3], "%", None, None, "5 % = honest; three degrees of freedom"),
    )
    return [
        Row(label, value, unit, most=high, least=low, note=why, peer=f"{name}: {other[k]:.1f}" if other else "")
        for k, (label, value, unit, low, high, why) in enumerate(rows)
    ]


def _false_points(points: PointErrors, beside: tuple[str, PointErrors]) -> list[Row]:
    name, reference = beside

    def rigs(p: PointErrors, bad: BoolArray) -> int:
        return len(np.unique(p.rig[bad]))

    def swapped(p: PointErrors) -> BoolArray:
        bad: BoolArray = p.swapped & p.measured
        return bad

    def far(p: PointErrors) -> BoolArray:
        bad: BoolArray = (p.error_m > _FAR_M) & p.measured
        return bad

    def peer(bad: BoolArray) -> str:
        return f"{name}: {rigs(reference, bad)}"

    return [
        Row(
            "rigs with a swap",
            rigs(points, swapped(points)),
            most=0,
            peer=peer(swapped(reference)),
            note=f"{int(swapped(points).sum())} points in all, told as measured, nearer to another marker",
        ),
        Row(
            "rigs with a point 50 mm off",
            rigs(points, far(points)),
            most=0,
            peer=peer(far(reference)),
            note=f"{int(far(points).sum())} points in all, told as measured",
        ),
        Row("the same, of all published points", rigs(points, points.error_m > _FAR_M)),
    ]


def _coverage(own: float, name: str, other: float) -> Row:
    note = "of frames' markers in two views, lost frames too: a measured point within 20 ms or one period"
    return Row("coverage", own, "%", peer=f"{name}: {other:.1f}", note=note)


def _at(values: FloatArray, share: float, scale: float = _MM) -> float:
    finite = values[np.isfinite(values)]
    return scale * float(np.percentile(finite, share)) if finite.size else float("nan")


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else float("nan")


Half = Literal["develop", "held-back"]

STRATA: Final = (
    Stratum("60 fps, 0.1 px", 60.0, 0.1, (1.3, 4.0)),
    Stratum("30 fps, 0.1 px", 30.0, 0.1, (2.2, 7.0)),
    Stratum("15 fps, 0.1 px", 15.0, 0.1, (5.0, 15.0)),
    Stratum("the whole family"),
)
"""Strata with their targets; the last one is the family as drawn, which has none of its own."""
_NAMES: Final = {"60": STRATA[0], "30": STRATA[1], "15": STRATA[2], "family": STRATA[3]}


@click.command()
@click.argument("data_path", metavar="DATA", type=click.Path(path_type=Path))
@click.option("--rigs", type=click.IntRange(min=1), default=6, show_default=True, help="Rigs to draw; 30 for a report.")
@click.option(
    "--seconds",
    type=FiniteRange(min=1.0),
    default=2.5,
    show_default=True,
    help="Of each clip; 6 for a report.",
)
@jobs_option("Rigs to run at the same time.")
@click.option(
    "--half",
    type=click.Choice(["develop", "held-back"]),
    default="develop",
    show_default=True,
    help="Half of the family; held-back is for final validation only, so that nothing is tuned to it.",
)
@click.option(
    "--markers",
    type=click.Choice(["caps", "bands", "points"]),
    default="caps",
    show_default=True,
    help="caps: cameras see the middle of the paint that faces them. bands: tape around each finger instead, whose end "
    "is bare for 3 mm. points: they see the marker's own middle, so that the filter alone is judged.",
)
@click.option("--stratum", "chosen", multiple=True, type=click.Choice(list(_NAMES)), help="Only this; may be repeated.")
@click.option("--first", type=click.IntRange(min=0), default=0, show_default=True, help="Number of the first rig.")
@json_option
def motion(
    data_path: Path,
    rigs: int,
    seconds: float,
    jobs: int,
    half: Half,
    markers: MarkerKind,
    chosen: tuple[str, ...],
    first: int,
    json_path: Path | None,
) -> None:
    """Track recorded hand motion with random simulated rigs, and compare points and hands with ground truth.

    DATA is a folder with recorded joints (msra14_*.csv, nyu_*.csv, fpha/S*_*.csv), or one that holds it as hand_motion.
    Each rig is drawn from a family (15 to 120 fps, any phase, 2 to 4 cameras, rolling shutters, lost frames, a
    calibration as wrong as it states) and looks at another clip, hand, paint and patch. Fingers, palm and an object in
    the hand hide what lies behind them.

    For comparison, two references run on the same tracks: a plain filter per marker (causal) and a cubic spline per
    camera and marker (offline). The same seeds give the same figures.
    """
    check_output("--json", json_path)
    list_recordings(data_path)
    strata = tuple(_NAMES[name] for name in chosen) or STRATA
    seeds = [2 * number + (half == "held-back") for number in range(first, first + rigs)]
    work = [Job(seed, data_path, seconds, strata, markers) for seed in seeds]
    console = Console(stderr=True, soft_wrap=True)
    results: list[list[RigResult]] = []
    with counted(console) as progress:
        task = progress.add_task("tracking rigs", total=len(work))
        for result in _run(work, jobs):
            results.append(result)
            progress.advance(task)
    sections = [
        section
        for number, stratum in enumerate(strata)
        for section in stratum_sections(stratum, [result[number] for result in results])
    ]
    drawn = {str(result[0].seed): [one.about for one in result] for result in results}
    show(
        "evaluate motion",
        sections,
        json_path,
        half=half,
        rigs=rigs,
        seconds=seconds,
        markers=markers,
        first=first,
        drawn=drawn,
    )


def _run(work: Sequence[Job], jobs: int) -> Iterator[list[RigResult]]:
    """Yield the results in the order of the work."""
    if jobs == 1:
        yield from map(run_job, work)
        return
    yield from each(run_job, work, jobs)
