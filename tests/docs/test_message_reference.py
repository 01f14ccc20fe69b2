"""The message reference says what the models say."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from rhot import messages
from rhot.messages import Message

DOCS = Path(__file__).parents[2] / "docs"


def test_the_reference_is_what_the_models_give() -> None:
    spec = importlib.util.spec_from_file_location("make_message_reference", DOCS / "make_message_reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert (DOCS / "messages.md").read_text() == module.page(), "run python docs/make_message_reference.py"


def test_every_message_and_field_is_described() -> None:
    text = (DOCS / "messages.md").read_text()
    models = [model for model in vars(messages).values() if isinstance(model, type) and issubclass(model, Message)]
    for model in models:
        if model is not Message:
            assert f"\n## {model.__name__}\n" in text
    empty = [line for line in text.splitlines() if line.startswith("| `") and line.endswith("|  |")]
    assert [line for line in empty if "schema_version" not in line] == []
