from __future__ import annotations

import numpy as np
import pytest
from touched.toucher import BOX, CYLINDER, SPHERE, Toucher

from rhot.errors import CalibrationError, ConfigError
from rhot.messages import BoxShape, FacedShape
from rhot_calibration.objects.touch.checks import flesh_note, judged
from rhot_calibration.objects.touch.faces import face_named, usual_faces
from rhot_calibration.objects.touch.fit import Touch

BEFORE = np.eye(3)


@pytest.mark.parametrize("shape", [BOX, CYLINDER, SPHERE])
def test_good_touches_stand_whatever_was_before(shape: FacedShape) -> None:
    touches = Toucher(shape).touches(usual_faces(shape), 4)
    found = judged(shape, touches, BEFORE)
    assert found.kept == tuple(range(len(touches)))
    assert not flesh_note(found.fit)


@pytest.mark.parametrize(
    ("shape", "faces", "per_face", "says"),
    [
        (BOX, ("top", "bottom"), 6, "touch front or back, left or right, too"),
        (BOX, ("top", "front", "right"), 2, "6 touches are too few, 7 are the least"),
        (CYLINDER, ("side",), 4, "touch top or bottom, too"),
        (CYLINDER, ("top", "bottom"), 4, r"touch side \(all round\), too"),
        (SPHERE, ("anywhere",), 1, "3 touches are too few"),
    ],
)
def test_too_few_touches_or_faces_are_refused(
    shape: FacedShape, faces: tuple[str, ...], per_face: int, says: str
) -> None:
    with pytest.raises(CalibrationError, match=says):
        judged(shape, Toucher(shape).touches(faces, per_face), BEFORE)


def test_touches_near_to_one_another_leave_it_open() -> None:
    toucher = Toucher(BOX)
    once = [toucher.touch(face, 0, 4) for face in ("top", "front", "right") for _ in range(4)]
    with pytest.raises(CalibrationError, match=r"near the corners|far from one another"):
        judged(BOX, once, BEFORE)


def test_a_face_taken_for_another_is_named() -> None:
    toucher = Toucher(BOX)
    touches = toucher.touches(("top", "front", "back", "left"), 4)
    wrong = [toucher.touch("bottom", number, 4, called="right") for number in range(4)]
    with pytest.raises(CalibrationError, match="touches of right contradict all others: 4 of 4 lie on bottom"):
        judged(BOX, touches + wrong, BEFORE)


def test_left_and_right_exchanged_are_refused() -> None:
    toucher = Toucher(BOX)
    names = {"left": "right", "right": "left"}
    touches = [
        toucher.touch(face, number, 4, called=names.get(face, face)) for face in usual_faces(BOX) for number in range(4)
    ]
    with pytest.raises(CalibrationError, match="contradict"):
        judged(BOX, touches, BEFORE)


def test_a_single_wrong_touch_is_left_out_by_name() -> None:
    toucher = Toucher(BOX)
    touches = toucher.touches(usual_faces(BOX), 4)
    touches[6] = toucher.touch("left", 2, 4, called="front")
    found = judged(BOX, touches, BEFORE)
    assert 6 not in found.kept
    assert len(found.kept) == len(touches) - 1


def test_a_wrong_size_is_refused_or_told() -> None:
    touches = Toucher(BOX).touches(usual_faces(BOX), 4)
    with pytest.raises(CalibrationError, match=r"size in rig\.toml|contradict"):
        judged(BoxShape(size=(0.13, 0.06, 0.065)), touches, BEFORE)
    thick = [Touch(touch.face, touch.tip_device, touch.radius_m - 0.004) for touch in touches]
    assert "mm more distance than its radius says" in flesh_note(judged(BOX, thick, BEFORE).fit)


def test_faces_have_names_and_axes() -> None:
    assert [face_named(BOX, text) for text in ("+y", " Top", "−x", "+z")] == ["top", "top", "left", "front"]
    assert face_named(CYLINDER, "-z") == "bottom"
    with pytest.raises(ConfigError, match="a cylinder has no face 'front'; its faces are top, side, bottom"):
        face_named(CYLINDER, "front")
