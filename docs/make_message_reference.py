"""Write docs/messages.md from the wire models: `python docs/make_message_reference.py`.

A test compares the file with what this prints, so that the reference cannot fall behind the code.
"""

from __future__ import annotations

import inspect
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from rhot import messages
from rhot.messages import WireModel

PAGE: Final = Path(__file__).with_name("messages.md")

KEYS: Final = {
    "MarkerFrame": ("rhot/markers/<camera>", "capture"),
    "PointSet": ("rhot/points", "fusion"),
    "HandPose": ("rhot/hand/<side>", "ik"),
    "ObjectPose": ("rhot/object/<id>", "objects; the page *Grasp* for a controller"),
    "HeadPose": ("rhot/head", "objects; the page *Grasp* for a WebXR headset"),
    "Space": ("rhot/space/<name>", "fusion, from the rig folder; or whoever knows it"),
    "FootPose": ("rhot/foot/<side>", "feet"),
    "BodyPose": ("rhot/body", "ik"),
    "Event": ("rhot/event", "`rhot mark`, programs"),
    "Control": ("rhot/control", "whoever starts or stops"),
    "ClockReply": ("rhot/clock", "fusion, as the answer to a query"),
    "ServiceStatus": ("rhot/status/<service>/<instance>", "every service, once a second"),
    "Truth": ("rhot/truth", "the simulated world"),
}
"""Each message with its key and who publishes it, in the order of the page."""

_HEAD: Final = """# Messages

<!-- Made by docs/make_message_reference.py from common/rhot/messages; do not edit. -->

Payloads are msgpack maps; the Zenoh encoding is `application/msgpack;<message>`. Units are metres, seconds, radians and
pixels (u to the right, v down, pixel centres on integers, raw image). Quaternions are (x, y, z, w). Times are integer
nanoseconds since the Unix epoch on the rig clock. A reader ignores fields that it does not know; a message in which
something is missing, wrong-typed, not finite or out of bounds is dropped, counted in the status and logged.

Every message has `t_ns` (time of the sample), `seq` (its number on this key since the publisher started, from 0; a gap
means lost messages) and `schema_version` (1). They are not repeated below.

Every key also answers a query with its last value, as JSON with `?format=json`: `rhot get 'rhot/**'`. Beside the
messages there are

| key | what |
|---|---|
| `rhot/alive/<service>/<instance>` | liveliness token |
| `rhot/rig` | query: the settings of the running rig, by whoever owns the clock; recordings carry them |
| `rhot/config/<service>/<instance>` | configuration: get it, put fields to change them while the service runs |
| `rhot/preview/<camera>` | query: a picture; `?overlay=markers`, `?mask=<marker>`, `?format=png` |
| `rhot/preview/feet` | query: what the feet's camera sees; `?overlay=depth`, `?overlay=none` |
| `rhot/keep/capture/<camera>` | query: exposure, gain, white balance and picture as rig.toml has them; \
`?do=save`, `?do=undo`; `?do=save_bounds` writes colour bounds into colors.json |
| `rhot/@pictures/<camera>`, `rhot/@sensors/<side>` | pictures and samples of ankle sensors, sent only while \
`rhot record --frames` runs; `**` does not match them |

Messages:
"""

_TYPE_NAMES: Final = {
    "Name": "name",
    "TimeNs": "integer, ns",
    "Count": "integer",
    "int": "integer",
    "str": "text",
    "Label": "text",
    "Sentence": "text",
    "bool": "true or false",
    "float": "number",
    "Pixel": "px",
    "PixelPoint": "(u, v) px",
    "Metres": "m",
    "Seconds": "s",
    "Unit": "0 to 1",
    "SignedUnit": "-1 to 1",
    "Position": "(x, y, z) m",
    "Quaternion": "(x, y, z, w)",
    "State": '"measured" or "predicted"',
    "Side": '"left" or "right"',
    "Matrix4": "4x4, rows",
}
"""What the reference calls the types of the source."""


def page() -> str:
    """Return the whole reference as Markdown."""
    parts = [_HEAD, "| key | message | from |\n|---|---|---|"]
    parts.extend(f"| `{key}` | [{name}](#{name.lower()}) | {who} |" for name, (key, who) in KEYS.items())
    text = "\n".join(parts) + "\n"
    return text + "".join(_section(getattr(messages, name)) for name in _with_parts())


def _with_parts() -> list[str]:
    """Return the messages, each followed by the parts that it is the first to use."""
    order: list[str] = []
    for name in KEYS:
        order.append(name)
        queue = [getattr(messages, name)]
        while queue:
            for field in queue.pop(0).model_fields.values():
                for part in _models_in(field.annotation):
                    if part.__name__ not in order:
                        order.append(part.__name__)
                        queue.append(part)
    return order


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, WireModel):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from _models_in(argument)


def _section(model: type[BaseModel]) -> str:
    summary, told = _docstring(model)
    where = f"\n`{KEYS[model.__name__][0]}`, from {KEYS[model.__name__][1]}.\n" if model.__name__ in KEYS else ""
    lines = [f"\n## {model.__name__}\n{where}\n{summary}\n", "| field | type | meaning |", "|---|---|---|"]
    for name, field in model.model_fields.items():
        if issubclass(model, messages.Message) and name in messages.Message.model_fields:
            continue
        need = "" if field.is_required() else ", optional"
        lines.append(f"| `{name}` | {_type(model, name, field)}{need} | {told.get(name, '')} |")
    return "\n".join(lines) + "\n"


def _docstring(model: type[BaseModel]) -> tuple[str, dict[str, str]]:
    """Return the summary of a model and what its docstring, or that of a base, says of each field."""
    told: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if isinstance(base, type) and issubclass(base, WireModel):
            told |= _attributes(inspect.cleandoc(base.__doc__ or ""))
    summary = inspect.cleandoc(model.__doc__ or "").partition("\nAttributes:\n")[0].strip()
    return summary, told


def _attributes(doc: str) -> dict[str, str]:
    entries = re.split(r"\n    (?=\S)", "\n" + inspect.cleandoc(doc).partition("Attributes:\n")[2])
    found: dict[str, str] = {}
    for entry in entries[1:]:
        names, _, text = entry.partition(":")
        for name in names.split(","):
            found[name.strip()] = " ".join(text.split()).replace("|", "\\|")
    return found


def _type(model: type[BaseModel], name: str, field: FieldInfo) -> str:
    """Return a field's type in words: the annotation as written in the source, without its bounds."""
    written = next(found for base in model.__mro__ if name in (found := inspect.get_annotations(base)))
    text = str(written[name]).replace(", Listed]", "]")
    text = re.sub(r", Field\([^()]*\)\]", "]", text).replace("Annotated[", "[")
    while (bare := re.sub(r"(?<![\w])\[((?:[^\[\]]|\w\[(?:[^\[\]]|\w\[[^\[\]]*\])*\])+)\]", r"\1", text)) != text:
        text = bare
    text = re.sub(r"\b(" + "|".join(_TYPE_NAMES) + r")\b", lambda match: _TYPE_NAMES[match[0]], text)
    text = re.sub(r"Literal\[([^\[\]]*)\]", lambda match: match[1].replace(", ", " or "), text)
    text = re.sub(r"dict\[((?:[^\[\],]|\([^()]*\))+), (.*)\]", r"map of \1 to \2", text)
    text = re.sub(r"dict\[(.+?), (.+)\]", r"map of \1 to \2", text)
    text = re.sub(r"tuple\[(.+), \.\.\.\]", r"list of \1", text)
    text = re.sub(r"tuple\[(.+)\]", r"(\1)", text)
    text = text.replace(" | None", "").replace("'", '"')
    for part in _models_in(field.annotation):
        text = re.sub(rf"\b{part.__name__}\b", f"[{part.__name__}](#{part.__name__.lower()})", text)
    return text.replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page())
