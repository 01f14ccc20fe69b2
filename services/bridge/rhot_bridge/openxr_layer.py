"""`rhot openxr`: builds the OpenXR API layer, registers it for this user, and says whether hands reach programs.

The loader looks for implicit layers in `$XDG_DATA_HOME/openxr/1/api_layers/implicit.d`, on Windows in the registry
(OpenXR loader specification, "API layer discovery").
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import monotonic_ns
from typing import Any, Final

import click
import numpy as np

from rhot.atomic_file import write_atomic
from rhot.errors import ConfigError
from rhot_bridge.targets.openxr import HANDS, MAGIC, PREDICTED, SIDES, VERSION, mapped_bytes, memory_path

LAYER: Final = "XR_APILAYER_RHOT_hands"
DISABLE: Final = "DISABLE_XR_APILAYER_RHOT_HANDS"
LIBRARY: Final = "rhot_openxr.dll" if os.name == "nt" else "librhot_openxr.so"
EXTENSIONS: Final = {
    "XR_EXT_hand_tracking": 4,
    "XR_EXT_hand_tracking_data_source": 1,
    "XR_FB_hand_tracking_aim": 2,
}
STALE_NS: Final = 250_000_000
"""As in `rhot_layer.c`."""
_REGISTRY: Final = r"Software\Khronos\OpenXR\1\ApiLayers\Implicit"
FLAGS: Final = (
    "-std=c11",
    "-O2",
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Werror",
    "-shared",
    "-fPIC",
    "-fvisibility=hidden",
)


def sources() -> Path:
    """Return the folder of `rhot_layer.c` and `rhot_hands.h`: of the package, or of the repository."""
    here = Path(__file__).resolve()
    packed = here.parent / "openxr"
    return packed if packed.exists() else here.parents[3] / "openxr"


def build(library: Path) -> None:
    """Compile the layer.

    Raises:
        ConfigError: there is no compiler or no header, or the layer cannot be compiled.
    """
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise ConfigError("the OpenXR layer needs a C compiler: apt install gcc libc6-dev libopenxr-dev")
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        made = Path(folder) / library.name
        command = [compiler, *FLAGS, str(sources() / "rhot_layer.c"), "-o", str(made), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ConfigError(_compile_problem(done.stderr))
        made.replace(library)


def _compile_problem(said: str) -> str:
    if "openxr/" in said and "No such file" in said:
        return (
            "the OpenXR layer needs the headers of OpenXR 1.0.30 or newer: apt install libopenxr-dev "
            "(Debian 13, Ubuntu 24.04), or name a built layer: rhot openxr install --library FILE"
        )
    return f"the OpenXR layer cannot be compiled:\n{said.strip()[-1500:]}"


# Registration.


def data_folder() -> Path:
    """Return the folder of this user's data."""
    variable, usual = ("LOCALAPPDATA", "AppData/Local") if os.name == "nt" else ("XDG_DATA_HOME", ".local/share")
    return Path(os.environ.get(variable) or Path.home() / usual)


def manifest_path() -> Path:
    """Return where this user's manifest of the layer is."""
    folder = "rhot" if os.name == "nt" else "openxr/1/api_layers/implicit.d"
    return data_folder() / folder / "rhot_hands.json"


def manifest(library: Path) -> dict[str, Any]:
    """Return the manifest of an implicit layer."""
    return {
        "file_format_version": "1.0.0",
        "api_layer": {
            "name": LAYER,
            "library_path": str(library),
            "api_version": "1.0",
            "implementation_version": "1",
            "description": "Hands tracked by RHOT, as XR_EXT_hand_tracking",
            "disable_environment": DISABLE,
            "instance_extensions": [
                {"name": name, "extension_version": version} for name, version in EXTENSIONS.items()
            ],
        },
    }


def register(library: Path) -> None:
    """Register a built layer for this user.

    Raises:
        ConfigError: the manifest cannot be written.
    """
    path = manifest_path()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, json.dumps(manifest(library), indent=2).encode() + b"\n")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
    if sys.platform == "win32":
        import winreg  # noqa: PLC0415

        with winreg.CreateKey(winreg.HKEY_CURRENT_USER, _REGISTRY) as key:
            winreg.SetValueEx(key, str(path), 0, winreg.REG_DWORD, 0)


def unregister() -> bool:
    """Take the layer away from this user; return whether it was there."""
    path = manifest_path()
    if sys.platform == "win32":
        import winreg  # noqa: PLC0415

        try:
            with winreg.OpenKey(winreg.HKEY_CURRENT_USER, _REGISTRY, 0, winreg.KEY_SET_VALUE) as key:
                winreg.DeleteValue(key, str(path))
        except FileNotFoundError:
            pass
    was_there = path.exists()
    path.unlink(missing_ok=True)
    return was_there


# Status.


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the chain from the bridge to a program: whether it holds, what was found, and what to do."""

    holds: bool
    found: str
    remedy: str = ""


def chain() -> Iterator[Step]:
    """Yield the steps from the program's side to the bridge's."""
    path = manifest_path()
    try:
        library = Path(json.loads(path.read_text())["api_layer"]["library_path"])
    except FileNotFoundError:
        yield Step(False, "the layer is not registered for this user", "rhot openxr install")
    except (OSError, ValueError, KeyError, TypeError):
        yield Step(False, f"{path}: not a manifest of ours", "rhot openxr install")
    else:
        if library.exists():
            yield Step(True, f"the layer is registered: {path}")
        else:
            yield Step(False, f"{path}: its library {library} is gone", "rhot openxr install")
    if DISABLE in os.environ:
        yield Step(False, f"{DISABLE} is set, so programs started from here leave the layer out", f"unset {DISABLE}")
    yield _runtime()
    yield from _hands()


def _runtime() -> Step:
    if os.name == "nt":
        return Step(True, "the OpenXR runtime is the registry's; RHOT does not look it up on Windows")
    named = os.environ.get("XR_RUNTIME_JSON")
    config = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    name = "openxr/1/active_runtime.json"
    candidates = [Path(named)] if named else [config / name, Path("/etc/xdg") / name, Path("/etc") / name]
    for path in candidates:
        if path.exists():
            return Step(True, f"the OpenXR runtime is {path.resolve()}")
    return Step(
        False,
        f"no OpenXR runtime: {'XR_RUNTIME_JSON names ' + named if named else 'no active_runtime.json'}",
        "start SteamVR, Monado or WiVRn once, and make it the active runtime in its settings",
    )


def _hands() -> Iterator[Step]:
    start = 'rhot bridge openxr (or [bridges.NAME] with target = "openxr" in rig.toml, and rhot up)'
    try:
        memory = mapped_bytes()
    except OSError:
        memory = b""
    if len(memory) < HANDS.itemsize:
        yield Step(False, "no bridge has written hands on this machine", start)
        return
    hands = np.frombuffer(memory, HANDS, 1)[0]
    if hands["magic"] != MAGIC or hands["version"] != VERSION:
        yield Step(False, f"{memory_path()} is of another version of RHOT", f"end the old bridge; then {start}")
        return
    now_ns = monotonic_ns()
    ages = {}
    for side, hand in zip(SIDES, hands["hands"], strict=True):
        age_ns = now_ns - int(hand["t_ns"])
        if hand["state"] >= PREDICTED and age_ns < STALE_NS:
            ages[side] = age_ns
    if ages:
        told = " and ".join(f"{side}, {age_ns / 1e6:.0f} ms old" for side, age_ns in ages.items())
        yield Step(True, f"hands in the memory: {told}")
    else:
        yield Step(False, "no hand is in the memory now", f"a started rig with a hand in view, and {start}")


# The command.


@click.group()
def openxr() -> None:
    r"""Give OpenXR programs the tracked hands, by a layer between them and their runtime.

    \b
    rhot openxr install          once
    rhot bridge openxr           while you play; or [bridges.NAME] in rig.toml
    rhot openxr status           what is missing

    docs/bridges/openxr.md says more.
    """


@openxr.command()
@click.option(
    "--library",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="A built layer to register; left out, it is compiled here.",
)
def install(library: Path | None) -> int:
    """Build the layer and register it for this user."""
    if library is None:
        if os.name == "nt":
            raise ConfigError("on Windows the layer is not compiled here; name a built one: --library rhot_openxr.dll")
        library = data_folder() / "rhot" / LIBRARY
        build(library)
    register(library.resolve())
    click.echo(f"{LAYER} is registered: {manifest_path()}")
    click.echo("Next: rhot bridge openxr, and start any OpenXR program; rhot openxr status shows the chain.")
    return 0


@openxr.command()
def remove() -> int:
    """Take the layer away from this user's programs."""
    if unregister():
        click.echo(f"{LAYER} is not registered any more.")
    else:
        click.echo(f"{LAYER} was not registered.")
    return 0


@openxr.command()
def status() -> int:
    """Show the chain from the tracked hands to a program; exit code 1 where it breaks."""
    steps = list(chain())
    for step in steps:
        click.echo(f"{'ok  ' if step.holds else 'no  '}{step.found}")
        if not step.holds and step.remedy:
            click.echo(f"    {step.remedy}")
    return 0 if all(step.holds for step in steps) else 1


if __name__ == "__main__":
    build(Path(sys.argv[1]))
