"""Every number of a configuration has an upper bound: nothing is accepted that fails in each sample."""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Iterator
from typing import Annotated, Any

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from rhot.rig.config import (
    CameraConfig,
    FusionConfig,
    HandConfig,
    IkConfig,
    MarkerConfig,
    ObjectConfig,
    RigConfig,
    SimConfig,
)
from rhot.rig.feet_config import BodyConfig, DepthCameraConfig, FeetConfig, FootConfig, ImuConfig
from rhot.rig.sections import BusConfig

MODELS = (
    BusConfig, CameraConfig, FusionConfig, HandConfig, IkConfig, MarkerConfig, ObjectConfig, RigConfig, SimConfig,
    BodyConfig, DepthCameraConfig, FeetConfig, FootConfig, ImuConfig,
)  # fmt: skip


def unbounded(annotation: Any, where: str) -> Iterator[str]:
    """Yield the numbers in a type that take any value."""
    origin = typing.get_origin(annotation)
    if annotation in (float, int) or (origin is Annotated and typing.get_args(annotation)[0] in (float, int)):
        for huge in (1e300, -1e300) if float in (annotation, *typing.get_args(annotation)) else (10**300,):
            try:
                TypeAdapter(annotation).validate_python(huge)
            except ValidationError:
                continue
            yield f"{where} takes {huge:g}"
    elif origin in (tuple, typing.Union, types.UnionType, Annotated):
        for part in typing.get_args(annotation):
            if not isinstance(part, type) or not issubclass(part, BaseModel):
                yield from unbounded(part, where)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_no_number_is_without_bounds(model: type[BaseModel]) -> None:
    hints = typing.get_type_hints(model, include_extras=True)
    found = [text for name in model.model_fields for text in unbounded(hints[name], f"{model.__name__}.{name}")]
    assert not [text for text in found if not text.startswith("CameraConfig.device")]


def test_the_longest_hold_is_refused_by_name() -> None:
    for model in (FusionConfig, IkConfig, FeetConfig):
        with pytest.raises(ValidationError, match="hold_s"):
            model(hold_s=1e300)
    assert math.isfinite(FusionConfig(hold_s=10.0).hold_s)
