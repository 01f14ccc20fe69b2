"""What a colour calibration says on the terminal: a table per marker, the matrix of confusion, warnings, advice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table

from rhot_calibration.colors.calibration import ColorCalibration
from rhot_calibration.colors.model.paints import Illumination, Suggestion, estimate_illumination, suggest
from rhot_calibration.colors.model.separability import BACKGROUND, CONFUSABLE, Separability
from rhot_calibration.colors.report.plot import share_text
from rhot_capture.detection.result import Detection


def marker_table(
    result: ColorCalibration, titles: Sequence[str], detections: Sequence[Mapping[str, Detection]]
) -> Table:
    """Return what the tracker finds with the new colours, marker by marker."""
    table = Table(
        title="Colours found",
        title_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1),
        collapse_padding=True,
        pad_edge=False,
    )
    several = len(titles) > 1
    table.add_column("marker", no_wrap=True)
    if several:
        table.add_column("picture")
    for heading in ("u,v", "area", "score", "kept"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("most like", no_wrap=True)
    for heading in ("distance", "mixed up", "margin"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, quality in result.markers.items():
        for title, found in zip(titles, detections, strict=True):
            detection = found.get(name)
            place = (
                ("-", "-", "not seen")
                if detection is None
                else (f"{detection.u:.1f},{detection.v:.1f}", f"{detection.area:.0f}", f"{detection.score:.2f}")
            )
            label = (name, title) if several else (name,)
            table.add_row(*label, *place, f"{100 * quality.recovered:.0f} %", *_nearest(result.separability, name))
    return table


def _nearest(apart: Separability, name: str) -> tuple[str, str, str, str]:
    other, confusion = apart.nearest(name)
    if not other:
        return "-", "-", "-", "-"
    row, column = apart.names.index(name), apart.names.index(other)
    margin = min(apart.margin[row, column], apart.margin[column, row])
    return (
        other,
        f"{apart.distance[row, column]:.1f}",
        f"{100 * confusion:.1f} %",
        f"{100 * margin:.0f} %" if margin <= 0.5 else "> 50 %",
    )


def confusion_table(apart: Separability) -> Table:
    """Return the matrix of expected confusion; a row is what is there, a column what it is taken for."""
    table = Table(
        title="Taken for, % of pixels, in light 20 % brighter or darker",
        title_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1),
        collapse_padding=True,
        pad_edge=False,
        caption="margin above: drift of the camera's red or blue gain until 5 % of the pixels change over",
        caption_justify="left",
    )
    table.add_column("is")
    for name in apart.seen:
        table.add_column(name if name != BACKGROUND else "backgr.", justify="right", no_wrap=True)
    for name, shares in zip(apart.classes, apart.expected, strict=True):
        cells = []
        for seen, share in zip(apart.seen, shares, strict=True):
            text = share_text(float(share))
            worse = name in apart.names and seen in apart.names and name != seen and share > CONFUSABLE
            cells.append(f"[yellow]{text}[/yellow]" if worse else text)
        table.add_row(name, *cells)
    return table


def warnings(result: ColorCalibration) -> list[str]:
    """Return a line for everything that will be confused, the worst first."""
    apart = result.separability
    lines = []
    for first, second, _ in apart.confusable():
        a, b = apart.names.index(first), apart.names.index(second)
        lines.append(
            f"warning: {first} and {second} will be mixed up: {100 * apart.expected[a, b]:.0f} % of {first} is taken "
            f"for {second} and {100 * apart.expected[b, a]:.0f} % of {second} for {first}"
        )
    for name, other, share in apart.lost():
        lines.append(f"warning: {name} fades into the {other}: {100 * share:.0f} % of its pixels are taken for it")
    for name, share in apart.skin_like():
        lines.append(
            f"warning: {100 * share:.0f} % of the skin is taken for {name}: was it picked on its paint? If so, use a "
            "paint that is less like skin"
        )
    for name, quality in result.markers.items():
        stray = quality.false_share * result.pixels.others_area / result.pixels.pictures
        if stray > result.pixels.area[name]:
            lines.append(
                f"warning: {stray:.0f} px of the surroundings look like {name}, which has "
                f"{result.pixels.area[name]:.0f} px itself; cover them, or use another paint"
            )
    return lines


def suggestions(result: ColorCalibration) -> list[str]:
    """Return advice for everything that will be confused: a better paint, or what else to try."""
    apart = result.separability
    pairs = [(first, second) for first, second, _ in apart.confusable()]
    pairs += [(name, other) for name, other, _ in apart.lost()]
    if not pairs:
        return []
    light = estimate_illumination(result.pixels)
    lines = []
    advised: set[str] = set()
    used: list[str] = []
    for first, second in pairs:
        if advised & {first, second}:
            continue
        found = suggest(result.colors, first, second, light, used)
        if found is None:
            what = (
                "a cloth of another colour" if second == BACKGROUND else "more even light, and picks in more pictures"
            )
            lines.append(f"{first} and {second}: no common paint would stand out better; try {what}")
            continue
        advised.add(found.marker)
        used.append(found.paint)
        lines.append(_advice(found, light))
    return lines


def _advice(found: Suggestion, light: Illumination) -> str:
    red, green, blue = (round(channel) for channel in found.rgb)
    return (
        f"suggestion: paint {found.marker} {found.paint} (about RGB {red}, {green}, {blue} in these pictures): its "
        f"distance to everything else would be {found.distance:.1f} instead of {found.present:.1f}. An estimate, light "
        f"judged by {light.source}; calibrate again to be sure"
    )
