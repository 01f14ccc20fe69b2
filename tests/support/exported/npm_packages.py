"""Packages of the npm registry, for tests whose judge is a JavaScript program."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

_INSTALL_LIMIT_S = 180.0


def npm_packages(config: pytest.Config, *packages: str) -> Path:
    """Return a folder with packages (`name@version`) in `node_modules`, kept in pytest's cache; skip without npm."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("needs node and npm: apt install nodejs npm")
    folder = config.cache.mkdir("npm-" + "-".join(packages).replace("/", "_").replace("@", "_"))
    if (folder / "whole").exists():
        return folder
    command = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--ignore-scripts", *packages]
    done = subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=_INSTALL_LIMIT_S,
        check=False,
        stdin=subprocess.DEVNULL,
    )
    if done.returncode:
        pytest.skip(f"npm cannot install {', '.join(packages)}: {(done.stderr or done.stdout).strip()[:200]}")
    (folder / "whole").touch()
    return folder
