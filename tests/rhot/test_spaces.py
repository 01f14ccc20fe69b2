"""A space's transform is rigid or the message is invalid."""

from __future__ import annotations

import pytest

from rhot.errors import WireError
from rhot.messages import Space, decode, encode

_TURNED = ((0.0, -1.0, 0.0, 0.1), (1.0, 0.0, 0.0, -0.2), (0.0, 0.0, 1.0, 0.8), (0.0, 0.0, 0.0, 1.0))
_SPACE = Space(t_ns=1, T_rig_space=_TURNED, source="desk board")


def test_it_comes_back_as_it_was() -> None:
    assert decode(encode(_SPACE), Space) == _SPACE


@pytest.mark.parametrize(
    "rows",
    [
        pytest.param(((-1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), *_TURNED[2:]), id="mirrored"),
        pytest.param(((2.0, 0.0, 0.0, 0.0), *_TURNED[1:]), id="scaled"),
        pytest.param((*_TURNED[:3], (0.0, 0.0, 0.1, 1.0)), id="projective"),
        pytest.param(((0.0, -1.0, 0.0, 1e6), *_TURNED[1:]), id="on the moon"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(rows: object) -> None:
    payload = encode(_SPACE.model_copy(update={"T_rig_space": rows}))
    with pytest.raises(WireError, match="T_rig_space"):
        decode(payload, Space)
