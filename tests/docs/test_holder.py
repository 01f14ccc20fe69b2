"""The printable holder: closed, as large as it says, and its holes where cameras, screws and tripods need them."""

from __future__ import annotations

import importlib.util
import itertools
import re
import struct
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from rhot.arrays import FloatArray

pytest.importorskip("manifold3d", reason="the holder is made with manifold3d: pip install 'rhot[holder]'")


DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_holder", DOCS / "make_holder.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_holder"] = module
    spec.loader.exec_module(module)
    return module


def corners_of(stl: bytes) -> FloatArray:
    """Return the triangles (N, 3, 3) of a binary STL file."""
    (count,) = struct.unpack_from("<I", stl, 80)
    assert len(stl) == 84 + 50 * count
    records = np.frombuffer(stl, dtype=[("floats", "<f4", (4, 3)), ("unused", "<u2")], offset=84)
    corners: FloatArray = records["floats"][:, 1:].astype(np.float64)
    return corners


def is_watertight(corners: FloatArray) -> bool:
    """Tell whether every edge is passed once in each direction."""
    edges: dict[tuple[bytes, bytes], int] = {}
    for triangle in corners.astype("<f4"):
        for a, b in itertools.pairwise([*triangle, triangle[0]]):
            edges[a.tobytes(), b.tobytes()] = edges.get((a.tobytes(), b.tobytes()), 0) + 1
    return all(count == 1 and edges.get((b, a)) == 1 for (a, b), count in edges.items())


def is_open(solid: Any, start: tuple[float, ...], end: tuple[float, ...]) -> bool:
    """Tell whether a straight line meets no material."""
    return not solid.ray_cast(list(start), list(end))


@pytest.mark.parametrize("part", ["bar", "carriage"])
@pytest.mark.parametrize("options", [{}, {"longest": 180.0, "toe_in": 8.0, "wall": 5.0}])
def test_parts_are_watertight_and_as_large_as_they_say(maker: ModuleType, part: str, options: dict[str, float]) -> None:
    holder = maker.Holder(**options)
    solid = getattr(maker, part)(holder)
    corners = corners_of(maker.stl(solid))
    assert is_watertight(corners)
    volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    assert volume == pytest.approx(solid.volume(), rel=1e-4)
    size = np.ptp(corners.reshape(-1, 3), axis=0)
    if part == "bar":
        np.testing.assert_allclose(size, (holder.bar_length, holder.bar_depth, holder.bar_height), atol=1e-3)
        assert size[0] >= holder.longest + holder.carriage_width
        # Four slots and the tripod's hole.
        assert solid.genus() == 5
    else:
        assert size[0] == pytest.approx(holder.carriage_width)
        # Pivot, arc, window and four screws.
        assert solid.genus() == 7


def test_camera_board_fits(maker: ModuleType) -> None:
    holder = maker.Holder()
    carriage = maker.carriage(holder)
    height = holder.lens_height
    for x, z in itertools.product((-10.5, 10.5), (0.0, 12.5)):
        assert is_open(carriage, (x, -60.0, height + z), (x, 60.0, height + z)), "M2 hole"
        assert not is_open(carriage, (x + 1.4, -60.0, height + z), (x + 1.4, 60.0, height + z)), "wall beside it"
    assert is_open(carriage, (0.0, -60.0, height), (0.0, 60.0, height)), "lens"
    # The board's lower edge clears the foot.
    assert height - (holder.board[1] - holder.lens_to_edge) >= holder.wall + 2.9


@pytest.mark.parametrize("toe_in", [-12.0, 0.0, 12.0])
@pytest.mark.parametrize("baseline", [50.0, 75.0, 140.0])
def test_both_screws_reach_through_at_every_baseline_and_toe_in(
    maker: ModuleType, baseline: float, toe_in: float
) -> None:
    holder = maker.Holder()
    whole = maker.assembled(holder, baseline, toe_in)
    for side in (-1.0, 1.0):
        x, y = side * 0.5 * baseline, holder.pivot_y
        assert is_open(whole, (x, y, -5.0), (x, y, 14.0 + holder.wall)), "pivot"
        lock = (x, y - holder.lock)
        assert is_open(whole, (*lock, -5.0), (*lock, 14.0 + holder.wall)), "lock"
    assert is_open(whole, (0.0, 0.0, -5.0), (0.0, 0.0, 30.0)), "tripod"


def test_what_cannot_be_made_is_refused(maker: ModuleType) -> None:
    for options, text in (
        ({"shortest": 20.0}, "two carriages"),
        ({"toe_in": 30.0}, "toe-in 30"),
        ({"bar_height": 7.0}, "at least 3 mm"),
    ):
        with pytest.raises(ValueError, match=text):
            maker.Holder(**options)
    with pytest.raises(ValueError, match="slots allow"):
        maker.assembled(maker.Holder(), 150.0, 0.0)


def test_command_writes_the_files(maker: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert maker.main([str(tmp_path / "out"), "--longest", "120"]) == 0
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"bar.stl", "carriage.stl", "holder.svg"}
    assert "bar.stl: 155.0 x 34.0 x 10.0 mm" in capsys.readouterr().out
    assert maker.main([str(tmp_path / "out"), "--shortest", "10"]) == 2
    assert "two carriages" in capsys.readouterr().err


def test_drawing_in_the_documentation_is_that_of_the_parts(maker: ModuleType) -> None:
    texts = maker.DRAWING.read_text(encoding="utf-8"), maker.drawing(maker.assembled(maker.Holder(), 75.0, 0.0))
    # Where two corners of the mesh are equally far out, the processor's rounding decides which one is drawn.
    number = re.compile(r"\d+\.?\d*")
    assert number.sub("0", texts[0]) == number.sub("0", texts[1])
    drawn, made = (np.array(number.findall(text), dtype=float) for text in texts)
    np.testing.assert_allclose(drawn, made, atol=0.5)
