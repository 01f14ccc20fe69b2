"""What somebody who holds a board sees of the session: maps of the pictures, bars, what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.text import Text

from rhot.bus import Bus
from rhot_calibration.cameras.live.coverage import (
    WANTED_FILL,
    WANTED_SHARED,
    WANTED_TILTED,
    WANTED_VIEWS,
    CameraCoverage,
)
from rhot_calibration.cameras.live.session import Progress, SessionState

# A camera's image from its running capture service.


async def preview_of(
    bus: Bus, camera: str, image_format: Literal["jpeg", "png"], timeout_s: float
) -> tuple[bytes | None, str]:
    """Return a camera's newest image, encoded, or None and the reason why there is none."""
    replies = await bus.get(f"rhot/preview/{camera}?format={image_format}", timeout_s=timeout_s)
    reply = next((reply for reply in replies if not reply.error), None)
    if reply is not None:
        return reply.payload, ""
    return None, replies[0].error if replies else "no answer to the query for its image"


_BAR_CELLS: Final = 10
_WIDE_UP_TO: Final = 4
"""With more cameras than this, a cell of the map is one character wide instead of two."""
_ADVICE: Final = 4
_GOOD: Final = (SessionState.HOLDING, SessionState.ACCEPTED, SessionState.COMPLETE)


def session_display(progress: Progress, silent: Mapping[str, str], *, keys: bool) -> RenderableType:
    """Return the whole display.

    Args:
        progress: of the session.
        silent: cameras that do not answer, and why.
        keys: whether keys can be pressed.
    """
    cell = 2 if len(progress.cameras) <= _WIDE_UP_TO else 1
    panels = [_camera(name, coverage, name in progress.seeing, cell) for name, coverage in progress.cameras.items()]
    return Group(
        Columns(panels),
        _links(progress),
        *(Text(f"{name} does not answer: {why}", style="bold red") for name, why in silent.items()),
        _state(progress),
        *(Text(f"  · {sentence}") for sentence in progress.missing[:_ADVICE]),
        Text(f"  … and {len(progress.missing) - _ADVICE} more" if len(progress.missing) > _ADVICE else "", style="dim"),
        Text("u undo   q finish   Ctrl-C finish" if keys else "Ctrl-C finishes with what there is", style="dim"),
    )


def state_line(progress: Progress) -> str:
    """Return what is happening, in words."""
    if progress.state is SessionState.HOLDING:
        return f"hold still … {progress.count}"
    return str(progress.state.value)


def _state(progress: Progress) -> Text:
    style = "bold green" if progress.state in _GOOD else "bold yellow"
    return Text(f"{progress.sets} taken.  {state_line(progress)}", style=style)


def _camera(name: str, coverage: CameraCoverage, sees: bool, cell: int) -> Panel:
    lines = ["".join(("█" if covered else "·") * cell for covered in row) for row in coverage.area]
    fill = float(coverage.fills.max(initial=0.0))
    least = float(coverage.fills.min()) if coverage.views else 0.0
    tilted = coverage.tilted
    arrows = " ".join(f"{arrow}{min(tilted[side], WANTED_TILTED)}" for side, arrow in zip(tilted, "←→↑↓", strict=True))
    lines += [
        f"area {100 * coverage.area_share:3.0f} %",
        f"near {_bar(fill / WANTED_FILL)}",
        f"far  {100 * least:3.0f} % of picture",
        f"tilt {arrows} of {WANTED_TILTED}",
        f"view {_bar(coverage.views / WANTED_VIEWS)} {coverage.views}",
    ]
    color = "green" if not coverage.missing else "cyan" if sees else "dim"
    return Panel("\n".join(lines), title=f"{name}{' ●' if sees else ''}", border_style=color, expand=False)


def _bar(share: float) -> str:
    cells = round(_BAR_CELLS * min(1.0, share))
    return "█" * cells + "░" * (_BAR_CELLS - cells)


def _links(progress: Progress) -> Text:
    pairs = [
        f"{a}–{b} {shared}" + ("" if shared >= WANTED_SHARED else f" of {WANTED_SHARED}")
        for (a, b), shared in progress.pairs.items()
        if shared or len(progress.cameras) <= _WIDE_UP_TO
    ]
    return Text("shared pictures: " + (", ".join(pairs) or "none yet"))
