"""Write docs/images/holder.svg, the drawing of the camera holder: `python docs/make_holder_drawing.py`.

All lengths in millimetres; one unit of the drawing is one millimetre: a print at 100 % is the template to drill by.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

DRAWING: Final = Path(__file__).with_name("images") / "holder.svg"

BAR: Final = (160.0, 40.0)
"""Width and height of the bar that both cameras are screwed to."""
BASELINE: Final = 75.0
"""Between the two lenses: the distance of the 2018 rig."""
BOARD: Final = (25.0, 24.0)
"""Width and height of a Pi camera's circuit board (modules 2 and 3)."""
LENS_BELOW_EDGE: Final = 14.5
"""From the board's edge opposite the cable to the axis of the lens."""
HOLES: Final = (21.0, 12.5)
"""Between the centres of a camera board's four holes, across and along; one pair is level with the lens."""
_MARGIN: Final = 30.0


def drawing() -> str:
    """Return the drawing as SVG text."""
    width, height = BAR
    middle, row = width / 2, height / 2
    parts = [_rectangle(0, 0, width, height, "none")]
    for side, name in ((-1, "left"), (1, "right")):
        x = middle + side * BASELINE / 2
        parts += [
            _rectangle(x - BOARD[0] / 2, row - LENS_BELOW_EDGE, *BOARD, "#e8f0e8"),
            f'<circle cx="{x}" cy="{row}" r="4"/>',
            _cross(x, row, 6.0),
            f'<text x="{x}" y="{row + BOARD[1] - LENS_BELOW_EDGE + 5}">{name}</text>',
        ]
        parts += [
            f'<circle cx="{x + dx * HOLES[0] / 2}" cy="{row + dy * HOLES[1]}" r="1.1"/>'
            for dx in (-1, 1)
            for dy in (0, -1)
        ]
    parts += [f'<circle cx="{x}" cy="{row}" r="2.75"/>' for x in (8.0, width - 8.0)]
    parts += [
        _dimension(middle - BASELINE / 2, middle + BASELINE / 2, -8.0, f"{BASELINE:g} lens to lens, parallel to 0.5°"),
        _dimension(0, width, -18.0, f"{width:g}"),
        _dimension(0, 8.0, height + 10.0, "8"),
        f'<text x="{width + 14}" y="{row}">{height:g}</text>',
        _note(middle, height + 17, "Seen from behind the cameras, top towards the far side of the desk."),
        _note(middle, height + 23, "3 to 4 mm aluminium or plywood; holes: 5.5 for the stand, 8 lenses, 2.2 boards"),
    ]
    total_w, total_h = width + 2 * _MARGIN, height + 2 * _MARGIN
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{total_w}mm" height="{total_h}mm" '
        f'viewBox="{-_MARGIN} {-_MARGIN} {total_w} {total_h}" fill="none" stroke="#222" stroke-width="0.35" '
        'font-family="sans-serif" font-size="3.6" text-anchor="middle">'
        "<style>text { fill: #222; stroke: none }</style>"
        f'<rect x="{-_MARGIN}" y="{-_MARGIN}" width="{total_w}" height="{total_h}" fill="white" stroke="none"/>'
        + "".join(parts)
        + "</svg>\n"
    )


def _note(x: float, y: float, text: str) -> str:
    return f'<text x="{x}" y="{y}">{text}</text>'


def _rectangle(x: float, y: float, width: float, height: float, fill: str) -> str:
    return f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="2" fill="{fill}"/>'


def _cross(x: float, y: float, size: float) -> str:
    return f'<path d="M {x - size} {y} H {x + size} M {x} {y - size} V {y + size}" stroke-dasharray="2 0.8 0.4 0.8"/>'


def _dimension(x0: float, x1: float, y: float, text: str) -> str:
    return (
        f'<path d="M {x0} {y - 2} V {y + 2} M {x1} {y - 2} V {y + 2} M {x0} {y} H {x1}"/>'
        f'<text x="{(x0 + x1) / 2}" y="{y - 1.5}">{text}</text>'
    )


if __name__ == "__main__":
    DRAWING.write_text(drawing())
