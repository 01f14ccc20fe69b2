"""What the page's steps share: each brings one calibration file, which can be tried, saved and undone."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

from rhot.calibration_step import Button, Field, Figures, Remark, StepContext, StepView
from rhot.errors import RhotError
from rhot.rig.calibration import CalibrationFile
from rhot.rig.kept_file import KeptFile

F = TypeVar("F", bound=CalibrationFile)
T = TypeVar("T")


def trial_buttons(file: str, what: str, try_hint: str = "") -> tuple[Button, Button, Button]:
    """Return the last three buttons of a step that brings `file`, which holds `what` in words for people."""
    return (
        Button("try", "try", try_hint or f"Write {file} and put the former one aside."),
        Button("save", "save", "Keep the result you tried."),
        Button("undo", "undo", f"Bring back the former {what}."),
    )


class PageStep(Generic[F]):
    """Base of the steps that bring a calibration file; see `rhot.calibration_step.CalibrationStep`.

    A step sets `_found` when it has a file to try, and does long work inside `_busy` or `_stoppable`.
    """

    about: str
    fields: tuple[Field, ...] = ()
    buttons: tuple[Button, ...] = ()

    def __init__(self, context: StepContext, path: Path, model: type[F]) -> None:
        """Begin with nothing found.

        Args:
            context: where the step works.
            path: of the calibration file.
            model: of its content.
        """
        self._context = context
        self._kept = KeptFile(path, model)
        self._found: F | None = None
        self._doing = ""
        self._task: asyncio.Task[Any] | None = None

    async def follow(self) -> None:
        """Look at the running rig while the step is shown; most steps wait for their button."""

    async def point(self, camera: str, u: float, v: float, values: Mapping[str, str]) -> None:
        """Take a click in a picture; most steps have nothing to click at."""

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Do what a button is for; a step handles its own buttons first and leaves the others to this.

        Raises:
            RhotError: it cannot be done.
        """
        if button == "try" and self._found is not None:
            self._kept.try_out(self._found)
        elif button == "save":
            self._kept.save()
        elif button == "undo":
            self._kept.undo()

    def _view(
        self,
        standing: tuple[str, bool],
        *,
        actions: set[str],
        share: float = 0.0,
        remarks: tuple[Remark, ...] = (),
        tables: tuple[Figures, ...] = (),
        pictures: Mapping[str, bytes] | None = None,
        held: Mapping[str, bytes] | None = None,
    ) -> StepView:
        """Return what the step shows; the buttons of the trial are offered while it does nothing else.

        Args:
            standing: of the stored file, see `_standing`.
            actions: names of the step's own buttons that can be pressed.
            share, remarks, tables, pictures, held: see `StepView`.
        """
        state, done = standing
        return StepView(
            self._doing or state,
            done and not self._doing,
            share=share,
            remarks=remarks,
            enabled=frozenset(actions if self._doing else actions | self._trial_actions()),
            tables=tables,
            pictures=pictures or {},
            held=held or {},
        )

    def _trial_actions(self) -> set[str]:
        """Return which of `try`, `save` and `undo` can be pressed."""
        possible = {"try": self._found is not None, "save": self._kept.on_trial, "undo": self._kept.can_undo}
        return {name for name, can in possible.items() if can}

    def _standing(
        self, absent: tuple[str, bool], trial: str, stored: Callable[[F], tuple[str, bool]]
    ) -> tuple[str, bool]:
        """Return in words how the file stands, and whether the rig is calibrated by it.

        Args:
            absent: without a file.
            trial: while it is on trial.
            stored: of its content otherwise.
        """
        try:
            content = self._kept.content
        except RhotError as error:
            return str(error), False
        if content is None:
            return absent
        return (trial, False) if self._kept.on_trial else stored(content)

    @contextmanager
    def _busy(self, doing: str) -> Iterator[None]:
        """Show what is being done, in a few words, until the block ends."""
        self._doing = doing
        try:
            yield
        finally:
            self._doing = ""

    @property
    def _can_stop(self) -> bool:
        """Whether work is under way that `_stop` ends."""
        return self._task is not None

    def _stop(self) -> None:
        """End the work of `_stoppable`; whoever waits for it goes on."""
        if self._task is not None:
            self._task.cancel()

    async def _stoppable(self, work: Coroutine[Any, Any, T]) -> T | None:
        """Return what the work brings, None when `_stop` ended it; the work ends with its caller."""
        self._task = task = asyncio.create_task(work)
        try:
            await asyncio.wait({task})
        finally:
            task.cancel()
            self._task = None
        return None if task.cancelled() else task.result()
