"""The files of `rhot export` that hold motion: BVH, TRC, MOT, C3D and glTF, in the stage where the floor is known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from rhot.atomic_file import replacing
from rhot.errors import ConfigError
from rhot.export.bvh import RIG_TO_FILE, STAGE_TO_FILE, bvh_text
from rhot.export.gltf.scene import gltf_document
from rhot.export.lab.c3d_file import MOST_FRAMES, write_c3d
from rhot.export.lab.frames import frames_of
from rhot.export.lab.opensim import coordinates_deg, mot_text, trc_text
from rhot.export.poses import Motion
from rhot.export.skeleton_motion import skeleton_motion
from rhot.rig.folder import write_text_atomic


@dataclass(frozen=True, slots=True)
class MotionTargets:
    """What to write; None = not asked for.

    Attributes:
        bvh, trc, mot, c3d, gltf: files.
        bvh_name: which motion goes into the BVH file, such as `hand_left` or `body`.
        rate_hz: frames per second; None = as recorded.
    """

    bvh: Path | None
    trc: Path | None
    mot: Path | None
    c3d: Path | None
    gltf: Path | None
    bvh_name: str | None
    rate_hz: float | None

    @property
    def any(self) -> bool:
        """Whether there is something to write."""
        return any(file is not None for file in (self.bvh, self.trc, self.mot, self.c3d, self.gltf))


def write_motion_files(targets: MotionTargets, found: dict[str, Motion], *, in_stage: bool) -> None:
    """Write motions and say what was written.

    Args:
        targets: what to write.
        found: the motions by name, in the stage or in the rig frame.
        in_stage: which of the two.

    Raises:
        ConfigError: there is nothing to write, or a file cannot be written.
    """
    if targets.bvh is not None:
        _write_bvh(targets.bvh, _chosen(found, targets.bvh_name), targets.rate_hz, in_stage=in_stage)
    every = [motion for _, motion in sorted(found.items())]
    lab = (targets.trc, targets.mot, targets.c3d, targets.gltf)
    if any(file is not None for file in lab) and not every:
        raise ConfigError("the recording holds no hand, body, foot, object or head to export")
    if targets.gltf is not None:
        document = gltf_document(every, "stage" if in_stage else "rig")
        with replacing(targets.gltf) as part:
            part.write_bytes(document.binary() if targets.gltf.suffix == ".glb" else document.text().encode())
        click.echo(f"{targets.gltf}: {', '.join(motion.name for motion in every)}, metres")
    if not any(file is not None for file in lab[:3]):
        return
    frames = frames_of(every, targets.rate_hz)
    told = f"{len(frames.t_s)} frames at {frames.rate_hz:.3f} Hz"
    if targets.trc is not None:
        write_text_atomic(targets.trc, trc_text(frames, targets.trc.name))
        click.echo(f"{targets.trc}: {len(frames.markers)} markers, {told}, metres")
    if targets.mot is not None:
        if not frames.angles:
            raise ConfigError("--mot: the recording holds no joint angles; hands and bodies have them")
        write_text_atomic(targets.mot, mot_text(frames, targets.mot.stem))
        click.echo(f"{targets.mot}: {len(coordinates_deg(frames))} angles, {told}, degrees")
    if targets.c3d is not None:
        files = write_c3d(targets.c3d, frames, y_up=in_stage)
        parts = f", in {len(files)} files of at most {MOST_FRAMES} frames" if len(files) > 1 else ""
        click.echo(f"{files[0]}: {len(frames.markers)} markers, {told}, millimetres{parts}")


def _chosen(found: dict[str, Motion], name: str | None) -> Motion:
    """Return the motion for the BVH file: the one that was named, else the only hand, else the only thing."""
    names = ", ".join(sorted(found)) or "nothing that moves"
    if name is not None:
        if name not in found:
            raise ConfigError(f"the recording holds no complete pose of {name}; there is {names}")
        return found[name]
    hands = [each for each in found if each.startswith("hand_")]
    if len(hands) > 1:
        raise ConfigError("the recording holds both hands; choose one with --hand left or --hand right")
    if hands:
        return found[hands[0]]
    if len(found) == 1:
        return next(iter(found.values()))
    raise ConfigError(f"the recording holds no complete pose of a hand, but {names}; choose with --bvh-of")


def _write_bvh(file: Path, motion: Motion, rate_hz: float | None, *, in_stage: bool) -> None:
    skeleton = skeleton_motion(motion, rate_hz)
    write_text_atomic(file, bvh_text(skeleton, STAGE_TO_FILE if in_stage else RIG_TO_FILE))
    console = Console(soft_wrap=True, markup=False)
    console.print(f"{file}: {motion.name}, {len(skeleton.root)} frames of {1e3 * skeleton.interval_s:.3f} ms, cm")
    if rate_hz is None:
        error_mm = 1e3 * float(np.linalg.norm(skeleton.positions() - motion.positions, axis=-1).max())
        console.print(f"joints within {error_mm:.4f} mm of the recording, constant bone lengths")
        if skeleton.timing_error_s > skeleton.interval_s / 2.0:
            console.print(
                f"poses came unevenly: up to {1e3 * skeleton.timing_error_s:.1f} ms from the time of their frame; "
                "--fps 60 puts them at their times",
                style="yellow",
            )
    if motion.incomplete:
        console.print(f"{motion.incomplete} poses lack joints and are left out", style="yellow")
