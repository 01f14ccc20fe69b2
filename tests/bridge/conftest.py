"""Programs of npm's that receive what bridges send."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from exported.foreign_programs import npm_packages

WEB = Path(__file__).parent / "web"


@pytest.fixture(scope="session")
def web(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the receivers and what they need; skipped where that is not installed."""
    folder = tmp_path_factory.mktemp("web")
    (folder / "node_modules").symlink_to(npm_packages() / "node_modules")
    for file in WEB.iterdir():
        shutil.copy(file, folder)
    return folder
