from __future__ import annotations

import sys
import threading
import time
from types import SimpleNamespace, TracebackType
from typing import Any, Self

import pytest

from rhot.errors import DeviceError
from rhot_tools.recordings import triggers
from rhot_tools.recordings.triggers import GpioPin

STAMPS = [1_700_000_000_000_000_000, 1_700_000_000_500_000_000]


class Header:
    """Stands in for gpiod and a Pi whose second chip has the header, with two edges of GPIO17."""

    def __init__(self) -> None:
        self.requested: dict[str, Any] = {}
        self.edges = [SimpleNamespace(timestamp_ns=stamp) for stamp in STAMPS]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.requested["released"] = True

    def chip(self, path: str) -> Any:
        """Open a chip."""
        return Chip(path)

    def request_lines(self, path: str, config: dict[str, Any], consumer: str) -> Self:
        """Take lines of a chip."""
        if not consumer:
            raise OSError(22, "Invalid argument")
        self.requested.update(path=path, config=config)
        return self

    def wait_edge_events(self, timeout_s: float) -> bool:
        """Wait for edges."""
        if not self.edges:
            time.sleep(timeout_s)
        return bool(self.edges)

    def read_edge_events(self) -> list[Any]:
        """Return the edges."""
        edges, self.edges = self.edges, []
        return edges


class Chip:
    """A chip of the simulated Pi; the second one has the header."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        pass

    def line_offset_from_id(self, name: str) -> int:
        """Return the number of a named line."""
        if not self._path.endswith("1") or name != "GPIO17":
            raise OSError(2, "No such line")
        return 17


@pytest.fixture
def header(monkeypatch: pytest.MonkeyPatch) -> Header:
    made = Header()
    line = SimpleNamespace(
        Edge=SimpleNamespace(RISING="rising"),
        Bias=SimpleNamespace(PULL_DOWN="down"),
        Clock=SimpleNamespace(REALTIME="r"),
    )
    module = SimpleNamespace(
        Chip=made.chip, LineSettings=lambda **settings: settings, request_lines=made.request_lines, line=line
    )
    monkeypatch.setitem(sys.modules, "gpiod", module)
    monkeypatch.setitem(sys.modules, "gpiod.line", line)
    chips = SimpleNamespace(glob=lambda _: ["/dev/gpiochip0", "/dev/gpiochip1"])
    monkeypatch.setattr(triggers, "Path", lambda _: chips)
    return made


def test_edges_of_a_pin_keep_the_kernels_stamps(header: Header) -> None:
    came: list[tuple[str, int]] = []
    ended = threading.Event()

    def tell(label: str, at_ns: int) -> None:
        came.append((label, at_ns))
        if len(came) == len(STAMPS):
            ended.set()

    GpioPin(17, "shutter").follow(tell, ended)
    assert came == [("shutter", stamp) for stamp in STAMPS]
    assert header.requested["path"] == "/dev/gpiochip1"
    assert header.requested["config"]["GPIO17"]["event_clock"] == "r"
    assert header.requested["released"]


def test_a_machine_without_the_pin_says_so(header: Header) -> None:
    with pytest.raises(DeviceError, match="no GPIO chip of this machine has a pin GPIO4"):
        GpioPin(4, "x")
