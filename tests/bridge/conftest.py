"""Programs of npm's that receive what bridges send."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

WEB = Path(__file__).parent / "web"
_INSTALL_LIMIT_S = 120.0


@pytest.fixture(scope="session")
def web(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the receivers and what they need; skipped where node, npm or its registry are missing."""
    if not shutil.which("node") or not shutil.which("npm"):
        pytest.skip("needs node and npm, which are not installed here")
    folder = tmp_path_factory.mktemp("web")
    for file in WEB.iterdir():
        shutil.copy(file, folder)
    command = [
        "npm",
        "install",
        "--no-audit",
        "--no-fund",
        "--no-package-lock",
        "--ignore-scripts",
        "--fetch-retries=0",
    ]
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=_INSTALL_LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        pytest.skip(f"npm's registry did not answer within {_INSTALL_LIMIT_S:.0f} s")
    if done.returncode:
        pytest.skip(f"npm cannot install the receivers here: {done.stderr.strip().splitlines()[-1:]}")
    return folder
