"""Walls between the packages, and rooms that stay small enough to find one's way in."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any, Final

import pytest

ROOT: Final = Path(__file__).parents[1]
MOST_MODULES: Final = 15
MOST_LINES: Final = 500


def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


WHEEL: Final = [Path(name) for name in project()["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]]
PACKAGES: Final = [*WHEEL, Path("bench/rhot_bench")]


def modules() -> list[Path]:
    return sorted(file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))


@pytest.fixture(scope="module")
def copied_packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("layers")
    shutil.copy(ROOT / "pyproject.toml", folder)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package.name, ignore=shutil.ignore_patterns("__pycache__", "static"))
    return folder


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-logo", "--no-cache"]
    environment = {**os.environ, "PYTHONPATH": str(folder), "COLUMNS": "200"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_nothing_imports_against_the_layers(copied_packages: Path) -> None:
    done = lint(copied_packages)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("file", "statement", "said"),
    [
        ("rhot/errors.py", "import rhot_capture.detection.blob", "rhot is not allowed to import rhot_capture"),
        ("rhot_ik/command.py", "from rhot_fusion import stage", "rhot_ik is not allowed to import rhot_fusion"),
        ("rhot_feet/service.py", "import rhot_tools.measures.output", "rhot_feet is not allowed to import rhot_tools"),
        ("rhot_viewer/service.py", "import rhot_calibration", "rhot_viewer is not allowed to import rhot_calibration"),
        ("rhot_calibration/__init__.py", "import rhot_sim", "rhot_calibration is not allowed to import rhot_sim"),
        ("rhot_sim/command.py", "import rhot_tools.measures.output", "rhot_sim is not allowed to import rhot_tools"),
        ("rhot_fusion/views/__init__.py", "import zenoh", "rhot_fusion.views is not allowed to import zenoh"),
        ("rhot/geometry/rotations.py", "import asyncio", "rhot.geometry is not allowed to import asyncio"),
    ],
)
def test_an_import_against_the_layers_is_refused(copied_packages: Path, file: str, statement: str, said: str) -> None:
    module = copied_packages / file
    before = module.read_text(encoding="utf-8")
    module.write_text(f"{before}\n{statement}\n", encoding="utf-8")
    try:
        done = lint(copied_packages)
    finally:
        module.write_text(before, encoding="utf-8")
    assert done.returncode != 0
    assert said in done.stdout


def test_the_wheel_holds_no_bench() -> None:
    points = project()["project"]["entry-points"]
    assert not any("rhot_bench" in target for group in points.values() for target in group.values())
    assert not any("bench" in str(package) for package in WHEEL)


def test_every_package_stands_in_a_layer() -> None:
    linter = project()["tool"]["importlinter"]
    layers = next(contract["layers"] for contract in linter["contracts"] if contract["type"] == "layers")
    names = sorted(package.name for package in PACKAGES)
    assert sorted(linter["root_packages"]) == names
    assert sorted(name.strip() for layer in layers for name in layer.split("|")) == names


def test_make_lint_checks_the_layers() -> None:
    recipe = (ROOT / "Makefile").read_text(encoding="utf-8").partition("\nlint:")[2].partition("\n\n")[0]
    assert "lint-imports" in recipe


def test_no_folder_holds_too_many_modules() -> None:
    files = [*modules(), *(ROOT / "tests").rglob("*.py")]
    counts = Counter(str(file.parent.relative_to(ROOT)) for file in files if file.name != "__init__.py")
    assert {folder: count for folder, count in counts.items() if count > MOST_MODULES} == {}


def test_no_module_is_too_long() -> None:
    lines = {str(file.relative_to(ROOT)): len(file.read_text(encoding="utf-8").splitlines()) for file in modules()}
    assert {file: count for file, count in lines.items() if count > MOST_LINES} == {}


def test_no_module_only_passes_on() -> None:
    assert [str(file.relative_to(ROOT)) for file in modules() if _passes_on(file)] == []


def _passes_on(file: Path) -> bool:
    """Return whether a module, not the face of its package, holds nothing but imports of other modules."""
    if file.name in ("__init__.py", "__main__.py"):
        return False
    body = ast.parse(file.read_text(encoding="utf-8")).body
    return all(
        isinstance(node, ast.Import | ast.ImportFrom)
        or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        or (isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__")
        for node in body
    )
