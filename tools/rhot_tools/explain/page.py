"""An explanation as one self-contained HTML page, to attach to a bug report."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from rhot.core import Explanation, ExplanationRow, Outline, PictureExplanation
from rhot.messages import MarkerFrame, PointSet
from rhot.report.html import html_page
from rhot.report.svg import line_plot
from rhot.rig import Rig
from rhot.rig.cameras import camera_model
from rhot_tools.explain.moment import Trace

_STYLE = """
body { max-width: 1320px; } td { vertical-align: top; }
tr.accepted td:last-child, tr.accepted td:first-child { color: #2d6a4f; }
tr.rejected td:last-child, tr.rejected td:first-child { color: #b00020; }
figure { display: inline-block; margin: 0 0.5em 1em 0; width: 48%; min-width: min(420px, 100%); vertical-align: top; }
figure svg { width: 100%; background: #111; } figcaption { font-size: 13px; color: #444; }
"""
_COLORS = {"accepted": "#3ddc97", "rejected": "#ff5a5f", "": "#ffd166"}
_POINT = "#5bc0ff"
_MARGIN_PX = 30.0
_LETTERS = 45.0
"""Width of a picture divided by the font size."""
_CIRCLE_PX = 9.0
"""Radius of the circle around a point; labels of crosses start outside it."""

Box = tuple[float, float, float, float]
"""Left, top, width and height of a part of a picture, pixels."""


def explanation_page(
    title: str,
    about: str,
    rig: Rig,
    trace: Trace,
    first: Sequence[Explanation],
    pictures: Mapping[str, PictureExplanation],
    rest: Sequence[Explanation],
) -> str:
    """Return the document.

    Args:
        title: heading.
        about: the recording, time and rig.
        rig: for its cameras.
        trace: of the processed seconds.
        first: tables above the pictures.
        pictures: of the cameras that have one.
        rest: tables below.
    """
    figures = "".join(
        _figure(rig, name, trace.frames.get(name), trace.points, pictures.get(name)) for name in rig.cameras
    )
    candidates = "".join(
        _table(explanation.candidates, f"{explanation.candidates.title} in {name}")
        for name, explanation in pictures.items()
    )
    body = (
        "".join(_table(table) for table in first)
        + f"<h2>Cameras</h2>{figures}{candidates}"
        + "".join(_table(table) for table in rest)
        + "<h2>Preceding seconds</h2>"
        + line_plot("markers seen by each camera", "time, s", "markers", trace.seen)
        + line_plot("sigma of each point", "time, s", "mm", trace.sigmas_mm)
        + line_plot("residual of each finger", "time, s", "mm", trace.residuals_mm)
    )
    return html_page(title, about, body, _STYLE)


def _table(table: Explanation, title: str = "") -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    note = f"<p><small>{escape(table.note)}</small></p>" if table.note else ""
    rows = "".join(map(_row, table.rows))
    return f"<h2>{escape(title or table.title)}</h2>{note}<table><tr>{head}</tr>{rows}</table>"


def _row(row: ExplanationRow) -> str:
    cells = "".join(f"<td>{escape(cell)}</td>" for cell in row.cells)
    return f"<tr class='{row.verdict}'>{cells}</tr>"


def _figure(
    rig: Rig, name: str, frame: MarkerFrame | None, points: PointSet | None, picture: PictureExplanation | None
) -> str:
    camera = rig.cameras[name]
    parts = []
    if picture is not None:
        data = base64.b64encode(picture.jpeg).decode()
        parts.append(
            f"<image href='data:image/jpeg;base64,{data}' x='-0.5' y='-0.5' width='{camera.width}' "
            f"height='{camera.height}'/>"
        )
        parts += [_outline(outline) for outline in picture.outlines]
    if frame is not None:
        parts += [
            _cross(marker.u, marker.v, "" if picture else marker_name) for marker_name, marker in frame.markers.items()
        ]
    if points is not None and points.points:
        positions = np.array([point.position for point in points.points.values()])
        uv = camera_model(camera).project(positions)
        for marker_name, (u, v) in zip(points.points, uv.tolist(), strict=True):
            if np.isfinite((u, v)).all():
                text = f"<title>{escape(marker_name)}, point of fusion</title>"
                parts.append(
                    f"<circle cx='{u:.2f}' cy='{v:.2f}' r='{_CIRCLE_PX:g}' fill='none' stroke='{_POINT}' "
                    f"stroke-width='1'>{text}</circle>"
                )
    when = "no frame" if frame is None else f"frame {frame.frame}, t_ns {frame.t_ns}, {len(frame.markers)} markers"
    blank = "" if picture is not None else " No picture was recorded."
    drawn = f"<g id='{escape(name)}'>{''.join(parts)}</g>"
    again = f"<use href='#{escape(name)}'/>"
    whole = (-0.5, -0.5, camera.width, camera.height)
    return (
        f"<figure>{_svg(whole, drawn)}"
        f"<figcaption><b>{escape(name)}</b>: {when}.{blank} Cross: published centre of a marker. Outline: blob of a "
        "marker's colour, green accepted, red rejected. Circle: point of fusion, projected.</figcaption></figure>"
        f"<figure>{_svg(_close_up(frame, whole), again)}"
        f"<figcaption><b>{escape(name)}</b>, enlarged</figcaption></figure>"
    )


def _svg(box: Box, drawn: str) -> str:
    numbers = " ".join(f"{value:g}" for value in box)
    return (
        f"<svg viewBox='{numbers}' xmlns='http://www.w3.org/2000/svg' font-family='sans-serif' "
        f"font-size='{box[2] / _LETTERS:.1f}'>{drawn}</svg>"
    )


def _close_up(frame: MarkerFrame | None, whole: Box) -> Box:
    """Return the part of a picture that contains its markers, with the picture's aspect ratio."""
    if frame is None or not frame.markers:
        return whole
    uv = np.array([(marker.u, marker.v) for marker in frame.markers.values()])
    middle, half = (uv.max(axis=0) + uv.min(axis=0)) / 2.0, np.ptp(uv, axis=0) / 2.0 + _MARGIN_PX
    half_width = min(max(half[0], half[1] * whole[2] / whole[3]), whole[2] / 2.0)
    half_height = half_width * whole[3] / whole[2]
    left = min(max(middle[0] - half_width, whole[0]), whole[0] + whole[2] - 2.0 * half_width)
    top = min(max(middle[1] - half_height, whole[1]), whole[1] + whole[3] - 2.0 * half_height)
    return left, top, 2.0 * half_width, 2.0 * half_height


def _outline(outline: Outline) -> str:
    points = " ".join(f"{u:.1f},{v:.1f}" for u, v in outline.points.tolist())
    color = _COLORS[outline.verdict]
    u, v = outline.points.max(axis=0).tolist()
    return (
        f"<polygon points='{points}' fill='none' stroke='{color}' stroke-width='0.8'/>"
        f"<text x='{u + 4:.1f}' y='{v:.1f}' fill='{color}' stroke='#000' stroke-width='2' paint-order='stroke'>"
        f"{escape(outline.label)}</text>"
    )


def _cross(u: float, v: float, label: str) -> str:
    lines = f"M{u - 4:.2f},{v:.2f}h8M{u:.2f},{v - 4:.2f}v8"
    text = (
        f"<text x='{u + _CIRCLE_PX + 3:.1f}' y='{v:.1f}' fill='{_COLORS['accepted']}'>{escape(label)}</text>"
        if label
        else ""
    )
    return f"<path d='{lines}' stroke='white' stroke-width='0.8'/>{text}"
