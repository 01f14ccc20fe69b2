from __future__ import annotations

import numpy as np
import pytest

from worlds.contact import Solid
from worlds.grasps import bars_of, run


def test_a_ring_is_grasped_and_tracked_through_its_mesh() -> None:
    pytest.importorskip("trimesh", reason="needs the extra `mesh`")
    found = run(8, known=True, smooth=False)
    assert found.kind == "ring"
    assert len(found.hidden) > 5
    assert np.median(found.hidden) < 0.03
    assert np.isfinite(found.sigma).all()


@pytest.mark.parametrize("half", [(25.0, 28.0, 40.0), (50.0, 6.0, 45.0)])
@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_what_hides_markers_is_the_object(kind: str, half: tuple[float, float, float]) -> None:
    """Bars stay inside, and fill it but for rounded corners."""
    radius = min(half[:2])
    thing = Solid(kind, np.array(half if kind == "box" else (radius, radius, half[2])))
    begin, end, radii = bars_of(thing)
    shares = np.linspace(0.0, 1.0, 21)[:, None, None]
    axes = 1e3 * (begin + shares * (end - begin))
    assert (thing.distance(axes) + 1e3 * radii).max() < 0.01
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (2000, 3)) * thing.half
    inside = points[thing.distance(points) < -3.0]
    apart = np.linalg.norm(inside[:, None, None] - axes, axis=-1) - 1e3 * radii
    assert (apart.min(axis=(1, 2)) < 2.0).mean() > 0.9
