"""Write the printable camera holder: `make holder`, or `python docs/make_holder.py FOLDER --baseline 90`.

Two parts, in millimetres: a bar with a thread for a tripod, and a carriage that carries one Raspberry Pi camera; print
the carriage twice. A carriage slides along the bar's two slots (baseline) and turns about its pivot screw (toe-in);
both screws lock both. FOLDER gets `bar.stl`, `carriage.stl` and `holder.svg`, a drawing of both assembled.

Coordinates: x along the bar, y the way the cameras look, z up; the bar lies on z = 0, its middle at x = 0.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click
import numpy as np
from numpy.typing import NDArray

try:
    from manifold3d import Manifold
except ImportError:  # an extra: nothing else needs it
    Manifold = None

FloatArray = NDArray[np.float64]
Solid = Any
"""A `manifold3d.Manifold`."""

DRAWING: Final = Path(__file__).with_name("images") / "holder-printed.svg"
_SEGMENTS: Final = 48
_THROUGH: Final = 200.0
"""Longer than any part: what is cut away goes right through."""


@dataclass(frozen=True, slots=True)
class Holder:
    """What may be chosen, millimetres and degrees.

    Attributes:
        shortest, longest: baselines that the slots allow; 75 is that of the 2018 rig.
        toe_in: each camera turns by this much to either side.
        bar_depth, bar_height: of the bar; 10 leaves 4 under the tripod's nut.
        screw: clearance hole of M4, for pivot and lock.
        lock: from the pivot to the lock screw.
        camera_holes: between the centres of a camera board's holes, across and up (modules 2 and 3).
        camera_screw: clearance hole of M2.
        opening: width and height of the window for lens and sensor.
        board: width and height of a camera board.
        lens_to_edge: from the lens to the board's edge opposite the cable; the upper holes lie 12.5 over the lens.
        wall: thickness of the carriage's foot and of its plate.
        tripod_hole: clearance of a 1/4"-20 UNC thread, 6.35.
        nut_flats, nut_height: of its hexagonal nut (7/16" and 7/32"), with 0.3 of play.
    """

    shortest: float = 50.0
    longest: float = 140.0
    toe_in: float = 12.0
    bar_depth: float = 34.0
    bar_height: float = 10.0
    screw: float = 4.3
    lock: float = 16.0
    camera_holes: tuple[float, float] = (21.0, 12.5)
    camera_screw: float = 2.2
    opening: tuple[float, float] = (15.0, 17.0)
    board: tuple[float, float] = (25.0, 24.0)
    lens_to_edge: float = 14.5
    wall: float = 4.0
    tripod_hole: float = 6.6
    nut_flats: float = 11.4
    nut_height: float = 5.9

    def __post_init__(self) -> None:
        """Refuse what cannot be made or used.

        Raises:
            ValueError: names the two figures that do not go together.
        """
        if not self.carriage_width < self.shortest < self.longest:
            raise ValueError(
                f"baseline from {self.shortest:g} to {self.longest:g} mm: two carriages are {self.carriage_width:g} mm "
                "wide each; the shortest must be more than that, and less than the longest"
            )
        if not 0.0 < self.toe_in <= 20.0:
            raise ValueError(f"toe-in {self.toe_in:g}°: more than 0 and at most 20, or the arc leaves its foot")
        if self.nut_height + 3.0 > self.bar_height:
            raise ValueError(
                f"bar_height {self.bar_height:g} mm: at least 3 mm must remain under a nut of {self.nut_height:g} mm"
            )

    @property
    def bar_length(self) -> float:
        """Of the bar: the longest baseline, half a carriage on both sides."""
        return self.longest + self.carriage_width + 4.0

    @property
    def carriage_width(self) -> float:
        """Of foot and plate: the camera board with 3 mm on both sides."""
        return self.board[0] + 6.0

    @property
    def lens_height(self) -> float:
        """Of the lens over the foot's underside: the board's cable edge stays clear of the foot."""
        return self.wall + 3.0 + self.board[1] - self.lens_to_edge

    @property
    def pivot_y(self) -> float:
        """Of the pivot, and of the slot that it slides in."""
        return 0.5 * self.lock


def bar(holder: Holder) -> Solid:
    """Return the bar as a solid."""
    solid = _box(holder.bar_length, holder.bar_depth, holder.bar_height)
    inner, outer = 0.5 * holder.shortest, 0.5 * holder.longest
    for side in (-1.0, 1.0):
        for y in (holder.pivot_y, holder.pivot_y - holder.lock):
            solid -= _slot(side * inner, side * outer, y, holder.screw)
    solid -= _hole(holder.tripod_hole)
    # The nut goes in from above: the screw pulls it onto the 4 mm that remain.
    nut = Manifold.cylinder(_THROUGH, *(2 * [holder.nut_flats / np.sqrt(3.0)]), 6)
    return solid - nut.translate([0.0, 0.0, holder.bar_height - holder.nut_height])


def carriage(holder: Holder) -> Solid:
    """Return the carriage as a solid; its pivot at x = y = 0, its foot's underside at z = 0."""
    width, wall = holder.carriage_width, holder.wall
    back, front = -holder.lock - 7.0, 11.0
    foot = _box(width, front - back, wall).translate([0.0, 0.5 * (front + back), 0.0])
    height = holder.lens_height + holder.lens_to_edge + 2.0
    plate = _box(width, wall, height).translate([0.0, front - 0.5 * wall, 0.0])
    solid = foot + plate
    for side in (-1.0, 1.0):
        x = side * 0.5 * (width - 3.0)
        # A rib keeps the plate from nodding.
        rib = Manifold.hull_points([[x + dx, y, z] for dx in (-1.5, 1.5) for y, z in _RIB])
        solid += rib.translate([0.0, front - wall, wall])
    solid -= _hole(holder.screw)
    steps = np.radians(np.linspace(-holder.toe_in, holder.toe_in, 25))
    holes = [
        _hole(holder.screw).translate([holder.lock * float(np.sin(a)), -holder.lock * float(np.cos(a)), 0.0])
        for a in steps
    ]
    for one, other in itertools.pairwise(holes):
        solid -= (one + other).hull()
    across, up = holder.camera_holes
    for x in (-0.5 * across, 0.5 * across):
        for z in (0.0, up):
            solid -= _hole(holder.camera_screw).rotate([90.0, 0.0, 0.0]).translate([x, 0.0, holder.lens_height + z])
    window = _box(holder.opening[0], _THROUGH, holder.opening[1])
    return solid - window.translate([0.0, front, holder.lens_height - 0.5 * holder.opening[1]])


_RIB: Final = ((-14.0, 0.0), (0.0, 0.0), (0.0, 14.0))
"""Corners of a rib, y and z, from the inner edge of foot and plate."""


def assembled(holder: Holder, baseline: float, toe_in: float) -> Solid:
    """Return bar and carriages put together.

    Args:
        holder: the parts.
        baseline: between the pivots, millimetres.
        toe_in: of each camera towards the other, degrees.

    Raises:
        ValueError: the slots do not allow it.
    """
    if not holder.shortest <= baseline <= holder.longest:
        raise ValueError(f"baseline {baseline:g} mm: the slots allow {holder.shortest:g} to {holder.longest:g}")
    if abs(toe_in) > holder.toe_in:
        raise ValueError(f"toe-in {toe_in:g}°: the arc allows {holder.toe_in:g}° to either side")
    solid = bar(holder)
    for side in (-1.0, 1.0):
        one = carriage(holder).rotate([0.0, 0.0, side * toe_in])
        solid += one.translate([side * 0.5 * baseline, holder.pivot_y, holder.bar_height])
    return solid


def triangles(solid: Solid) -> FloatArray:
    """Return the triangles (N, 3, 3) of a solid's surface, millimetres, outside counter-clockwise."""
    mesh = solid.to_mesh()
    corners: FloatArray = np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3][np.asarray(mesh.tri_verts)]
    return corners


def stl(solid: Solid) -> bytes:
    """Return a solid as binary STL, millimetres."""
    corners = triangles(solid)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    records = np.zeros(len(corners), dtype=[("floats", "<f4", (4, 3)), ("unused", "<u2")])
    records["floats"] = np.concatenate([normals[:, None], corners], axis=1)
    return b"RHOT camera holder, millimetres".ljust(80) + np.uint32(len(corners)).tobytes() + records.tobytes()


def drawing(solid: Solid) -> str:
    """Return a solid seen from above, in front and the right, as SVG: its edges, without those that are hidden."""
    turn, tilt = np.radians(-28.0), np.radians(32.0)
    spin = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    lean = np.array([[1, 0, 0], [0, np.sin(tilt), np.cos(tilt)], [0, -np.cos(tilt), np.sin(tilt)]])
    # From the front: y towards the eye. Rows are right, up and towards the eye.
    corners = triangles(solid) @ (lean @ np.diag([-1.0, -1.0, 1.0]) @ spin).T
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    nearest = _nearest(corners, low)
    lines = []
    for start, end in _edges(corners):
        points = start + np.linspace(0.0, 1.0, max(2, int(np.linalg.norm(end - start) * 3)))[:, None] * (end - start)
        at = np.clip(((points[:, :2] - low[:2]) * _GRID).astype(int) + 1, 0, np.array(nearest.shape) - 1)
        seen = points[:, 2] > nearest[at[:, 0], at[:, 1]] - 0.6
        for run in np.split(np.arange(len(seen)), np.flatnonzero(np.diff(seen.astype(int))) + 1):
            if seen[run[0]] and len(run) > 1:
                (x0, y0), (x1, y1) = points[run[0], :2], points[run[-1], :2]
                lines.append(f"M{x0 - low[0]:.1f} {high[1] - y0:.1f}L{x1 - low[0]:.1f} {high[1] - y1:.1f}")
    width, height = (high - low)[:2] + 8.0
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{4 * width:.0f}" height="{4 * height:.0f}" '
        f'viewBox="-4 -4 {width:.1f} {height:.1f}" fill="none" stroke="#222" stroke-width="0.35">'
        f'<rect x="-4" y="-4" width="{width:.1f}" height="{height:.1f}" fill="white" stroke="none"/>'
        f'<path stroke-linecap="round" d="{"".join(lines)}"/></svg>\n'
    )


_GRID: Final = 4.0
"""Cells to the millimetre of the map that says what hides what."""


def _nearest(corners: FloatArray, low: FloatArray) -> FloatArray:
    """Return how near the surface is to the eye, on a grid over its first two coordinates; −inf where nothing is."""
    size = ((corners.max(axis=(0, 1)) - low)[:2] * _GRID).astype(int) + 3
    nearest = np.full(size, -np.inf)
    for a, b, c in corners:
        first = np.floor((np.minimum(np.minimum(a, b), c) - low)[:2] * _GRID).astype(int)
        last = np.ceil((np.maximum(np.maximum(a, b), c) - low)[:2] * _GRID).astype(int) + 1
        x, y = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[1], last[1]), indexing="ij")
        u, v = x / _GRID + low[0], y / _GRID + low[1]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) < 1e-9:
            continue
        s = ((u - a[0]) * (c[1] - a[1]) - (v - a[1]) * (c[0] - a[0])) / area
        t = ((b[0] - a[0]) * (v - a[1]) - (b[1] - a[1]) * (u - a[0])) / area
        inside = (s >= -1e-6) & (t >= -1e-6) & (s + t <= 1.0 + 1e-6)
        depth = a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2])
        part = nearest[first[0] + 1 : last[0] + 1, first[1] + 1 : last[1] + 1]
        np.maximum(part, np.where(inside, depth, -np.inf), out=part)
    return nearest


def _edges(corners: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return the edges at which a surface bends by more than 20°."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    faces: dict[tuple[bytes, ...], list[int]] = {}
    ends: dict[tuple[bytes, ...], tuple[FloatArray, FloatArray]] = {}
    for face, triangle in enumerate(corners):
        for k in range(3):
            pair = triangle[k], triangle[(k + 1) % 3]
            key = tuple(sorted(np.round(point, 4).tobytes() for point in pair))
            faces.setdefault(key, []).append(face)
            ends[key] = pair
    return [ends[key] for key, two in faces.items() if len(two) < 2 or normals[two[0]] @ normals[two[1]] < 0.94]


def _box(x: float, y: float, z: float) -> Solid:
    """Return a box whose underside's middle is the origin."""
    return Manifold.cube([x, y, z], True).translate([0.0, 0.0, 0.5 * z])


def _hole(diameter: float) -> Solid:
    """Return what a drill along z through the origin takes away."""
    return Manifold.cylinder(_THROUGH, 0.5 * diameter, 0.5 * diameter, _SEGMENTS, True)


def _slot(x0: float, x1: float, y: float, width: float) -> Solid:
    """Return what a slot along x takes away; x0 and x1 are the extreme places of its screw."""
    return (_hole(width).translate([x0, y, 0.0]) + _hole(width).translate([x1, y, 0.0])).hull()


def main(arguments: list[str] | None = None) -> int:
    """Write the files; the command line is described by `--help`."""
    parser = argparse.ArgumentParser(description="Write the printable camera holder: STL files and a drawing.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path("build/holder"))
    parser.add_argument("--baseline", type=float, default=75.0, help="of the drawing, mm (default 75)")
    parser.add_argument("--toe-in", type=float, default=0.0, help="of the drawing, degrees (default 0)")
    parser.add_argument("--docs", action="store_true", help="write the drawing of the documentation, nothing else")
    for field in dataclasses.fields(Holder):
        if isinstance(field.default, float) and field.name != "toe_in":
            name = "--" + field.name.replace("_", "-")
            parser.add_argument(name, type=float, default=field.default, help=f"mm (default {field.default:g})")
    given = vars(parser.parse_args(arguments))
    if Manifold is None:
        click.echo("the holder needs manifold3d: pip install 'rhot[holder]'", err=True)
        return 1
    folder, baseline, toe_in, docs = (given.pop(name) for name in ("folder", "baseline", "toe_in", "docs"))
    try:
        holder = Holder(**given)
        picture = drawing(assembled(holder, baseline, toe_in))
    except ValueError as error:
        click.echo(f"holder: {error}", err=True)
        return 2
    if docs:
        DRAWING.write_text(picture, encoding="utf-8")
        return 0
    folder.mkdir(parents=True, exist_ok=True)
    for name, solid in (("bar", bar(holder)), ("carriage", carriage(holder))):
        (folder / f"{name}.stl").write_bytes(stl(solid))
        x, y, z = (solid.bounding_box()[k + 3] - solid.bounding_box()[k] for k in range(3))
        click.echo(f"{folder / name}.stl: {x:.1f} x {y:.1f} x {z:.1f} mm, {solid.volume() / 1000:.0f} cm³ of plastic")
    (folder / "holder.svg").write_text(picture, encoding="utf-8")
    click.echo(f"{folder / 'holder.svg'}: print one bar and two carriages; docs/build.md says how")
    return 0


if __name__ == "__main__":
    sys.exit(main())
