"""Options of methods that are not the rig's own, as `rig.toml` states them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from rhot.errors import ConfigError
from rhot.messages.base import first_problem
from rhot.rig.file_model import FileModel

Model = TypeVar("Model", bound=FileModel)


def checked(model: type[Model], options: Mapping[str, Any], part: str) -> Model:
    """Return options as the model that they should be.

    Args:
        model: of the options.
        options: as `rig.toml` has them.
        part: `fusion` or `ik`.

    Raises:
        ConfigError: one is unknown or out of bounds.
    """
    try:
        return model.model_validate(dict(options))
    except ValidationError as error:
        raise ConfigError(f"rig.toml, [{part}.options]: {first_problem(error)}") from error
