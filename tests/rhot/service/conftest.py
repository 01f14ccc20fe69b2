"""Services that tell of themselves often."""

from __future__ import annotations

import pytest

from rhot.service import runner


@pytest.fixture(autouse=True)
def quick_status(monkeypatch: pytest.MonkeyPatch) -> None:
    """Publish the status often, so that tests need not wait for the next second."""
    monkeypatch.setattr(runner, "_STATUS_INTERVAL_S", 0.05)
