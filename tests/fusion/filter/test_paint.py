"""Occluded paint and the visible side of a finger: offset between the centres of a marker and of its visible paint."""

from __future__ import annotations

import numpy as np
import pytest
from hands.pinholes import CAMERAS, FOCAL_PX

from rhot.arrays import FloatArray
from rhot_fusion.filter.paint import Paint
from rhot_fusion.views.sightings import vector


def half_hidden(rate_hz: float) -> tuple[Paint, FloatArray, FloatArray]:
    """Return where one camera sees half of what the other does after a third of a second, and how sure that is."""
    paint, one, depth, period_s, sure = (
        Paint(CAMERAS, np.full(1, 0.0065)),
        [0],
        [0.8],
        1.0 / rate_hz,
        [True],
    )
    for number in range(round(rate_hz / 3.0)):
        paint.correct(0, one, number * period_s, [100.0], depth, period_s, sure)
        shift, doubt = paint.correct(1, one, number * period_s + 0.005, [50.0], depth, period_s, sure)
    return paint, shift, doubt


def test_hidden_paint_is_made_up_for_on_its_own_side() -> None:
    paint, shift, doubt = half_hidden(60.0)
    # A third or more of 10 px is hidden in the right camera: by something on its right.
    assert 1.0 < shift[0, 0] * FOCAL_PX < 2.5
    assert doubt[0] > 0.0
    level, _ = paint.correct(0, [0], 1.0, [100.0], [0.8], 1.0 / 60.0, [True])
    assert np.abs(level).max() == 0.0


@pytest.mark.parametrize(("missing", "least", "most"), [(0.0, 0.0, 0.0), (0.08, 0.05, 0.35), (0.5, 0.85, 1.0)])
def test_a_small_difference_is_hardly_hidden_paint_and_a_large_one_is_all_of_it(
    missing: float, least: float, most: float
) -> None:
    paint = Paint(CAMERAS, np.full(1, 0.0065))
    for number in range(20):
        paint.correct(0, [0], number / 60.0, [100.0], [0.8], 1.0 / 60.0, [True])
        areas = [100.0 * (1.0 - missing)]
        shift, _ = paint.correct(1, [0], number / 60.0 + 0.005, areas, [0.8], 1.0 / 60.0, [True])
    # The strip is as high as the square that has the marker's area.
    strip_px = 0.5 * missing * 10.0
    assert least * strip_px <= shift[0, 0] * FOCAL_PX <= most * strip_px


def test_paint_that_no_camera_shows_leaves_its_middle_open() -> None:
    """A tip may bend away and show 0.59 of its area; of what shows a quarter, three fifths of that are missing."""
    paint = Paint(CAMERAS, np.array([0.0065, 0.0]))
    width_m = 10.0 / FOCAL_PX * 0.8
    found = []
    for number, share in enumerate([1.0, 0.7, 0.25]):
        for camera in (0, 1):
            t_s, areas_px = number + 0.005 * camera, [100.0 * share] * 2
            paint.correct(camera, [0, 1], t_s, areas_px, [0.8] * 2, 1.0 / 60.0, [True] * 2)
        found.append(paint.hidden_m2(0) ** 0.5)
        assert paint.hidden_m2(1) == 0.0, "a patch has a doubt of its own"
    assert found[:2] == [0.0, 0.0]
    assert found[2] == pytest.approx(0.5 * (1.0 - 0.25 / 0.588) * width_m, rel=0.1)


def test_what_the_pictures_border_cuts_off_is_made_up_for() -> None:
    paint, depth_m = Paint(CAMERAS, np.full(1, 0.0065)), 0.8
    for number in range(20):
        paint.correct(0, [0], number / 60.0, [144.0], [depth_m], 1.0 / 60.0, [True])
    # Of a square of 12 pixels the right 8 are seen: their middle is 4 from the border, the whole one's 2.
    border = np.array([[4.0 / FOCAL_PX, -1.0, 0.0]])
    shift, doubt = paint.correct(0, [0], 1.0, [96.0], [depth_m], 1.0 / 60.0, [True], border)
    assert shift[0] * FOCAL_PX == pytest.approx((-2.0, 0.0), abs=0.1)
    assert doubt[0] * FOCAL_PX > 1.0
    border[0, 0] = 6.5 / FOCAL_PX
    shift, _ = paint.correct(0, [0], 1.017, [144.0], [depth_m], 1.0 / 60.0, [True], border)
    assert np.abs(shift).max() * FOCAL_PX < 0.1, "it does not reach over the border"


def test_what_hides_paint_for_many_frames_is_not_averaged_away() -> None:
    """Views of a tenth of a second tell as much of where the hidden half is, however many frames that is."""
    told = {}
    for rate_hz in (5.0, 30.0, 120.0):
        doubt = float(half_hidden(rate_hz)[2][0])
        told[rate_hz] = max(0.1 * rate_hz, 1.0) / doubt**2
    assert told[120.0] == pytest.approx(told[5.0], rel=0.15)
    assert told[30.0] == pytest.approx(told[5.0], rel=0.15)


def test_a_bent_finger_is_seen_on_its_near_side() -> None:
    """A tip straight ahead that points away from the camera: its middle is nearer to the hand than what is seen."""
    paint = Paint(CAMERAS, np.full(1, 0.0065))
    paint.bend[0] = -0.6
    ends = np.array([[0.0, -0.05, 0.8], [0.0, 0.05, 0.78]])
    along, other = (
        paint.along(camera, [0], [100.0], [vector(tip)], [vector(base)], [0.0])[0]
        for camera, (tip, base) in enumerate(one.to_camera(ends) for one in CAMERAS)
    )
    assert along[1] * 0.8 == pytest.approx(0.66 * 0.0065 * 0.6, rel=0.1)
    # Each camera sees more of the side on its own side, which looks like less disparity than the middle has.
    assert 0.1 < (along[0] - other[0]) * FOCAL_PX < 0.6


def test_a_camera_that_looks_along_a_finger_misses_no_paint_for_that() -> None:
    """It points away and to the left, so the right camera sees less of it; where its end curls, nobody knows that."""
    shifts_px = []
    for reach_m in (0.0, 1.0):
        paint, far, shift = Paint(CAMERAS, np.full(1, 0.0065)), 0.4, np.zeros((1, 2))
        direction, tip = np.array([-0.8, 0.0, 0.6]), np.array([0.045, 0.0, far])
        for number in range(60):
            for k, one in enumerate(CAMERAS):
                sight = (one.center - tip) / np.linalg.norm(one.center - tip)
                c = float(direction @ sight)
                area = 400.0 * (3.6 * (1.0 - c * c) ** 0.5 + 0.5 * np.pi * (1.0 + c)) / (3.6 + 0.5 * np.pi)
                # At first it is seen from the side.
                area = 400.0 if number < 20 else area
                t_s = number / 60.0 + 0.005 * k
                shift, _ = paint.correct(k, [0], t_s, [area], [far], 1.0 / 60.0, [True])
                ends = one.to_camera(np.array([tip, tip - 0.09 * direction]))
                paint.along(k, [0], [area], [vector(ends[0])], [vector(ends[1])], [reach_m])
        shifts_px.append(float(shift[0, 0]) * FOCAL_PX)
    assert abs(shifts_px[0]) < 0.1
    assert shifts_px[1] > 0.5


@pytest.mark.parametrize(("share", "told"), [(0.6, 0.0), (0.8, 0.5), (1.0, 1.0)])
def test_paint_of_a_curled_finger_indicates_its_direction_less(share: float, told: float) -> None:
    paint = Paint(CAMERAS, np.full(1, 0.0065))
    tip, base = (0.0, -0.05, 0.8), (0.0, 0.05, 0.8)
    (unknown,) = paint.along(0, [0], [100.0], [tip], [base], [0.0])
    (shift,) = paint.along(0, [0], [100.0], [tip], [base], [0.1 / share])
    assert shift == pytest.approx((told * unknown[0], told * unknown[1]))
    assert abs(unknown[1]) > 1e-4


def test_a_patch_that_is_half_hidden_is_where_it_is_seen() -> None:
    """A sleeve covers it on an unknown side: the centre may be off by 7.5 of its 30 px."""
    paint, period_s = Paint(CAMERAS, np.zeros(1)), 1.0 / 60.0
    for number in range(20):
        paint.correct(0, [0], number * period_s, [900.0], [0.8], period_s, [True])
        shift, doubt = paint.correct(1, [0], number * period_s + 0.005, [450.0], [0.8], period_s, [True])
    assert np.abs(shift).max() == 0.0
    assert 5.0 < doubt[0] * FOCAL_PX < 10.0


def test_uncertainty_of_a_patch_of_unknown_distance_is_limited_by_its_size() -> None:
    """One camera sees more of it than the other before anything tells how large it is."""
    paint = Paint(CAMERAS, np.zeros(1))
    paint.correct(1, [0], 0.0, [173.0], [0.75], 1.0 / 60.0, [False])
    _, doubt = paint.correct(0, [0], 0.002, [125.0], [0.75], 1.0 / 60.0, [False])
    assert 0.0 < doubt[0] * FOCAL_PX < np.sqrt(173.0)


def test_paint_that_one_camera_loses_first_is_made_up_for_at_once() -> None:
    """Something passes before a thumb at 0.15 m/s, from the right: in a twentieth of a second a camera loses half."""
    paint, period_s = Paint(CAMERAS, np.full(1, 0.0065)), 1.0 / 60.0
    shift, missed_px = np.zeros((1, 2)), []
    for number in range(24):
        hidden = min(max(number - 20, 0) / 6.0, 0.5)
        paint.correct(0, [0], number * period_s, [150.0], [0.8], period_s, [True])
        t_s = number * period_s + 0.005
        shift, _ = paint.correct(1, [0], t_s, [150.0 * (1.0 - hidden)], [0.8], period_s, [True])
        # What is hidden is a strip of the square that has its area.
        missed_px.append(0.5 * hidden * 150.0**0.5 - shift[0, 0] * FOCAL_PX)
    assert max(np.abs(missed_px)) < 0.75, "less than half a pixel but for what whole markers differ by"


@pytest.mark.parametrize("rate_hz", [20.0, 30.0])
def test_a_finger_that_curls_hides_nothing_from_the_camera_that_looks_later(rate_hz: float) -> None:
    """Both cameras, out of step, see a tip shrink from 300 to 100 square pixels in 0.12 s: nothing hides any of it."""
    paint, period_s = Paint(CAMERAS, np.full(1, 0.0065)), 1.0 / rate_hz
    shifts_px = []
    for number in range(round(0.62 * rate_hz)):
        for camera, later_s in ((0, 0.0), (1, 0.3 * period_s)):
            t_s = number * period_s + later_s
            area = 300.0 - 200.0 * min(max(t_s - 0.5, 0.0) / 0.12, 1.0)
            shift, _ = paint.correct(camera, [0], t_s, [area], [0.8], period_s, [True])
            if t_s > 0.5 + 1.3 * period_s:
                shifts_px.append(abs(shift[0, 0]) * FOCAL_PX)
    assert max(shifts_px) < 0.5, "three quarters of a pixel and more, were areas of different moments compared"


def test_skin_beside_a_curled_finger_tells_where_its_middle_is() -> None:
    """From its knuckle nothing is known of the end of a curled finger; skin above it shows that it points down."""
    paint, tip, base = Paint(CAMERAS, np.full(1, 0.0065)), (0.0, 0.0, 0.8), (0.02, -0.02, 0.78)
    reach_m = 0.1
    assert paint.along(0, [0], [50.0], [tip], [base], [reach_m]) == [(0.0, 0.0)]
    for number in range(30):
        paint.correct(0, [0], number / 60.0, [100.0], [0.8], 1.0 / 60.0, [True], None, np.array([[0.0, -0.2]]))
    paint.bend[0] = -0.6
    ((x, y),) = paint.along(0, [0], [50.0], [tip], [base], [reach_m])
    assert y * 0.8 == pytest.approx(-0.66 * 0.0065 * 0.6, rel=0.15)
    assert abs(x) < 0.2 * abs(y)


def test_of_a_small_rest_cameras_see_different_parts() -> None:
    paint, period_s = Paint(CAMERAS, np.full(1, 0.0065)), 1.0 / 60.0
    for number in range(30):
        for camera in (0, 1):
            paint.correct(camera, [0], number * period_s, [150.0], [0.8], period_s, [True])
    doubts = []
    for area in (150.0, 75.0, 30.0, 15.0):
        for camera in (0, 1):
            _, doubt = paint.correct(camera, [0], 1.0, [area], [0.8], period_s, [True])
        doubts.append(float(doubt[0]))
    assert doubts[0] < 1e-4
    assert doubts[0] <= doubts[1] < doubts[2] < doubts[3]


@pytest.mark.parametrize(("skin", "moved"), [((-0.2, 0.2), True), ((0.2, 0.2), False), ((0.0, 0.0), False)])
def test_a_gap_that_shows_either_camera_another_side_becomes_no_depth(skin: tuple[float, float], moved: bool) -> None:
    """Of a tip that was whole both see 0.3, of which each lies beside skin: on opposite sides only behind a gap."""
    paint, radius_m = Paint(CAMERAS, np.full(1, 0.0065)), 0.0065
    shifts, doubts = [np.zeros((1, 2))] * 2, [np.zeros(1)] * 2
    for number in range(40):
        for camera in (0, 1):
            area, side = (100.0, 0.0) if number < 20 else (30.0, skin[camera])
            shifts[camera], doubts[camera] = paint.correct(
                camera, [0], number / 60.0, [area], [0.8], 1.0 / 60.0, [True], skin=np.array([[side, 0.0]])
            )
    width = 2.0 * radius_m / 0.8
    apart = shifts[1][0, 0] - shifts[0][0, 0]
    if moved:
        # 1.5 (1 − 0.3 / 0.7) of the width for each unit of the difference, of which noise takes a quarter.
        assert 0.2 * width < apart < 0.34 * width
        assert shifts[0][0, 0] == pytest.approx(-shifts[1][0, 0], rel=0.01)
        assert doubts[0][0] > abs(shifts[0][0, 0])
    else:
        assert apart == pytest.approx(0.0, abs=1e-9)
