"""Programs of others that tests hand our output to, as `make foreign` installs them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

FOREIGN = Path(__file__).resolve().parents[3] / ".foreign"


def npm_packages() -> Path:
    """Return the folder whose `node_modules` holds the packages of tests/foreign/package.json; skip without them."""
    if shutil.which("node") is None:
        pytest.skip("needs node and npm: apt install nodejs npm")
    folder = FOREIGN / "npm"
    if not (folder / ".ready").exists():
        pytest.skip("needs programs of npm: make foreign")
    return folder


def ros_python() -> Path:
    """Return an interpreter with real ROS 2, see tests/foreign/ros.txt; skip without it."""
    folder = FOREIGN / "ros"
    if not (folder / ".ready").exists():
        pytest.skip("needs ROS 2's Python packages: make foreign")
    return folder / "bin" / "python"
