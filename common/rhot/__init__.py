"""RHOT: an open-source tracker of hands and objects from two cameras and painted fingertips.

`rhot.load` opens a recording as arrays, `rhot.track` tracks one again, `rhot.connect` reads a running rig.
`rhot.messages` holds the wire schemas, `rhot.bus` the connection itself.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rhot.take.live import connect
    from rhot.take.reading import load
    from rhot.take.take import Take
    from rhot.take.tracking import track

__version__ = "0.1.0"
__all__ = ["Take", "__version__", "connect", "load", "track"]

_WHERE = {"Take": "take", "connect": "live", "load": "reading", "track": "tracking"}


def __getattr__(name: str) -> Any:
    """Load what is asked for: services and the command line import this package and need none of it."""
    if name not in _WHERE:
        raise AttributeError(f"module 'rhot' has no attribute {name!r}")
    return getattr(importlib.import_module(f"rhot.take.{_WHERE[name]}"), name)
