"""What a tab of the page's panel is."""

from __future__ import annotations

from typing import Protocol

import viser


class Panel(Protocol):
    """One tab; made once, for all browsers.

    viser calls back on threads of its own: a panel wraps its callbacks in `Page.on_loop`, so that everything of ours
    runs on one event loop.
    """

    @property
    def title(self) -> str:
        """Label of the tab, one word."""
        ...

    def build(self, gui: viser.GuiApi) -> None:
        """Add the tab's elements; called inside the tab."""
        ...

    def update(self) -> None:
        """Bring the elements up to date; called four times a second while a browser is connected."""
        ...
