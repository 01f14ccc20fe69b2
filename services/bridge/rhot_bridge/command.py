"""`rhot bridge`."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import click
from pydantic import ValidationError

from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import ConfigError
from rhot.messages import first_problem
from rhot.rig import BridgeConfig
from rhot.rig.folder import RIG_FILE, load_config
from rhot.service.stop import run_to_the_end
from rhot_bridge.output import unsupported_setting
from rhot_bridge.service import serve_bridges
from rhot_bridge.targets import TARGETS, TARGETS_OF


@click.command()
@click.argument("target", required=False)
@click.option(
    "--host", help="Where the other program runs; for a WebSocket, the address to listen on.  [default: 127.0.0.1]"
)
@click.option("--port", type=click.IntRange(1, 65535), help="Its port; that program's usual one when left out.")
@click.option("--rate-hz", type=FiniteRange(1.0, 200.0), help="Most frames per second.  [default: 90]")
@click.option(
    "--predicted",
    type=click.Choice(["send", "absent"]),
    help="Send what is predicted, or treat it as absent.  [default: send]",
)
@click.option(
    "--absent",
    type=click.Choice(["keep", "fade", "stop"]),
    help="Of what is not tracked any more: send the last, let it fade, or send nothing.  [default: fade]",
)
@click.option(
    "--axes",
    type=click.Choice(["stage", "unity", "rig"]),
    help="json, lsl, ros2: metres from the floor, the same in Unity's axes, or the rig's own.  [default: stage]",
)
@click.option(
    "--transport", type=click.Choice(["websocket", "udp"]), help="json only: how it is sent.  [default: websocket]"
)
@click.option(
    "--body",
    type=click.Choice(["fingers", "arms"]),
    help="vmc only: fingers alone, or arms, hips and feet, too.  [default: fingers]",
)
@click.option(
    "--height-m", type=FiniteRange(0.5, 2.5), help="vmc with arms: height of the person, metres.  [default: 1.7]"
)
@click.option(
    "--allow-origin",
    "allow_origins",
    multiple=True,
    metavar="URL",
    help="json only: a web page that may read it, such as https://example.org. May be repeated.",
)
@click.option(
    "--offset",
    type=(FiniteRange(-10.0, 10.0), FiniteRange(-10.0, 10.0), FiniteRange(-10.0, 10.0), FiniteRange(-360.0, 360.0)),
    metavar="X Y Z TURN",
    help="openxr only: move all hands by x, y, z metres after a turn about the vertical, degrees.  [default: 0 0 0 0]",
)
@rig_option
@bus_options
def bridge(target: str | None, rig_path: Path, connect: tuple[str, ...], namespace: str | None, **settings: Any) -> int:
    """Send what the rig tracks to another program, until Ctrl-C.

    \b
    TARGET is one of
    TABLE
    or the NAME of a [bridges.NAME] of rig.toml. Without TARGET all of those run, as they do in `rhot up`.

    Most programs expect positions relative to a floor; `rhot doctor` shows whether it is known. docs/bridges.md
    explains the setup of each program.
    """
    known = load_config(rig_path).bridges if (rig_path / RIG_FILE).exists() else {}
    given = {name: value for name, value in settings.items() if value not in (None, ())}
    bridges = _chosen(target, known, given, rig_path)
    return run_to_the_end(serve_bridges(bridges, tool_bus(rig_path, connect, namespace)))


bridge.help = inspect.cleandoc(bridge.help or "").replace(
    "TABLE\n", "".join(f"  {name:8}{kind.summary}\n" for name, kind in TARGETS.items())
)


def _chosen(
    target: str | None, known: dict[str, BridgeConfig], given: dict[str, Any], rig_path: Path
) -> dict[str, BridgeConfig]:
    if target is None:
        if not known:
            raise click.UsageError(
                f"which program? one of {', '.join(TARGETS)}; {rig_path / RIG_FILE} has no [bridges.NAME] either"
            )
        if given:
            raise click.UsageError("options belong to one bridge; name it, or write them into rig.toml")
        return known
    if target in known:
        chosen = known[target]
    elif target in TARGETS:
        chosen = BridgeConfig.model_validate({"target": target})
    else:
        own = f", or one of rig.toml: {', '.join(known)}" if known else ""
        raise click.UsageError(f"there is no bridge to {target!r}; one of {', '.join(TARGETS)}{own}")
    for name in given:
        if chosen.target not in TARGETS_OF.get(name, TARGETS):
            raise ConfigError(f"bridge {target}: {unsupported_setting(name, chosen.target)}")
    try:
        return {target: BridgeConfig.model_validate({**chosen.model_dump(), **given})}
    except ValidationError as error:
        raise ConfigError(f"bridge {target}: {first_problem(error)}") from error
