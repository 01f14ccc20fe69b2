"""What a distribution holds beside the repository: the commit it was made from; a wheel, the OpenXR layer too."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Hook(BuildHookInterface[Any]):
    """Adds them; not to a development installation, which has all in the repository."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Take part in a build."""
        if version == "editable":
            return
        root, package = Path(self.root), Path("common/rhot/commit")
        if self.target_name == "wheel":
            build_data["force_include"][str(root / "openxr")] = "rhot_bridge/openxr"
        # A source distribution brings the file, among the package's own.
        if not (root / package).exists() and (commit := _commit(root)):
            file = root / "build" / "commit"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(commit + "\n", encoding="utf-8")
            build_data["force_include"][str(file)] = str(package if self.target_name == "sdist" else "rhot/commit")


def _commit(root: Path) -> str:
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()
