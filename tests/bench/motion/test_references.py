"""The references find a point that moves smoothly, from views that are out of step."""

from __future__ import annotations

import numpy as np

from rhot.arrays import FloatArray
from rhot_bench.motion.references.plain_ekf import plain_ekf
from rhot_bench.motion.references.spline_reference import SplineViews, spline_reference, triangulated
from rhot_tools.measures.points import MEASURED, Estimates

BASELINE_M = 0.1
P = np.stack([np.eye(4)[:3], np.column_stack([np.eye(3), [-BASELINE_M, 0.0, 0.0]])])


def path(t_s: FloatArray) -> FloatArray:
    """A tip that swings at up to 0.9 m/s and 8 m/s²."""
    return np.column_stack([0.1 * np.sin(9.0 * t_s), 0.05 * np.cos(7.0 * t_s), 0.7 + 0.06 * np.sin(6.0 * t_s)])


def swinging(noise_px: float, lost: slice = slice(0)) -> SplineViews:
    """Views at 60 Hz of two cameras out of step by 7 ms."""
    rng = np.random.default_rng(0)
    t_s = np.sort(np.concatenate([np.arange(0.0, 2.0, 1.0 / 60.0), np.arange(0.007, 2.0, 1.0 / 60.0)]))
    camera = np.arange(len(t_s)) % 2
    X = path(t_s)
    X[camera == 1, 0] -= BASELINE_M
    xy = X[:, :2] / X[:, 2:] + rng.normal(0.0, noise_px / 520.0, (len(t_s), 2))
    kept = np.ones(len(t_s), dtype=bool)
    kept[lost] = False
    return SplineViews(
        np.arange(len(t_s))[kept],
        camera[kept],
        np.zeros(int(kept.sum()), dtype=np.int64),
        10**12 + np.round(1e9 * t_s[kept]).astype(np.int64),
        xy[kept],
        P,
        np.full(2, 520.0),
        np.full(2, 1.0 / 60.0),
    )


def errors_mm(found: Estimates) -> FloatArray:
    errors: FloatArray = 1e3 * np.linalg.norm(
        found.position - path(np.asarray(found.t_ns - 10**12, dtype=np.float64) * 1e-9), axis=1
    )
    return errors


def test_triangulation_of_three_views_is_exact_and_one_view_is_no_point() -> None:
    third = np.column_stack([np.eye(3), [0.0, -0.2, 0.05]])
    cameras = np.concatenate([P, third[None]])
    X = np.array([[0.05, -0.03, 0.8], [0.0, 0.1, 0.6]])
    seen = np.einsum("cij,nj->nci", cameras[:, :, :3], X) + cameras[:, :, 3]
    xy = seen[..., :2] / seen[..., 2:]
    xy[1, 1:] = np.nan
    found = triangulated(xy, cameras)
    np.testing.assert_allclose(found[0], X[0], atol=1e-9)
    assert np.isnan(found[1]).all()


def test_no_views_are_no_points() -> None:
    assert triangulated(np.empty((0, 2, 2)), P).shape == (0, 3)


def test_spline_of_exact_views_is_within_a_tenth_of_a_millimetre() -> None:
    found = spline_reference(swinging(0.0), 1)
    assert len(found.t_ns) > 200
    assert np.percentile(errors_mm(found), 99) < 0.1


def test_spline_is_not_read_across_a_long_gap() -> None:
    found = spline_reference(swinging(0.0, slice(60, 100)), 1)
    t_s = (found.t_ns - 10**12) * 1e-9
    assert not ((t_s > 0.53) & (t_s < 0.80)).any()
    assert np.percentile(errors_mm(found), 95) < 0.5


def test_plain_filter_follows_causally_and_stays_positive() -> None:
    views = swinging(0.3)
    found = plain_ekf(views, len(views.frame), 1)
    settled = (found.state == MEASURED) & (found.t_ns > 10**12 + 3 * 10**8)
    assert np.median(errors_mm(found)[settled]) < 3.0
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0


def test_plain_filter_starts_again_after_a_gap() -> None:
    views = swinging(0.1, slice(60, 130))
    found = plain_ekf(views, len(views.frame), 1)
    after = found.t_ns > 10**12 + int(1.3e9)
    assert after.any()
    assert np.median(errors_mm(found)[after]) < 3.0
