"""What `rhot doctor` finds out about the bus: who can reach it, and whether certificates fit the rig."""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rhot.errors import RhotError
from rhot.keys import AUTHORITY, ROLES_FILE, certificate_file, load_roles
from rhot.rig import Rig
from rhot.text import as_argument


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report: how bad, what, and what to do about it."""

    level: Literal["ok", "note", "warn", "bad"]
    text: str
    remedy: str = ""


def check_bus(rig: Rig) -> Iterator[Finding]:
    """Tell who can reach the bus: is it open, and do certificates fit the rig."""
    bus = rig.config.bus
    reachable = [each for each in bus.listen if not is_local(each)]
    where = ", ".join(reachable)
    if bus.tls:
        yield from _check_keys(rig)
        if reachable:
            yield Finding("ok", f"the router listens on {where}, for who holds a certificate of this rig")
    elif reachable:
        yield Finding(
            "warn",
            f"the router listens on {where} without certificates: whoever reaches it can read, stop and change the rig",
            f"rhot keys make --address ADDRESS --rig {as_argument(rig.path)}, or listen on 127.0.0.1",
        )
    else:
        yield Finding(
            "ok",
            "the bus is closed: its router lets only this machine in",
            f"for cameras on other machines: rhot keys make --address ADDRESS --rig {as_argument(rig.path)}",
        )
    if bus.multicast:
        yield Finding("warn", "multicast is on: the rig looks for others, and others find it", "multicast = false")


def is_local(endpoint: str) -> bool:
    """Return whether an endpoint can be reached from this machine only."""
    protocol, _, address = endpoint.partition("/")
    return protocol.startswith("unix") or address.startswith(("127.", "localhost:", "[::1]"))


def _check_keys(rig: Rig) -> Iterator[Finding]:
    folder = Path(rig.config.bus.keys)
    if not certificate_file(folder, AUTHORITY).exists():
        yield Finding(
            "bad", f"[bus] tls is on, but {folder} holds no certificates", "rhot keys make, or rhot keys install"
        )
        return
    loose = [file.name for file in folder.glob("*.key") if os.access(file, os.R_OK) and file.stat().st_mode & 0o077]
    if loose:
        yield Finding(
            "bad", f"{folder}: others on this machine can read {', '.join(loose)}", f"chmod 600 {folder}/*.key"
        )
    if not (folder / ROLES_FILE).exists():
        yield Finding("ok", f"{folder}: this machine takes part in a secured bus")
        return
    try:
        holders = load_roles(folder).holders
    except RhotError as error:
        yield Finding("bad", str(error), "the router lets nobody in; correct the file")
        return
    yield Finding("ok", f"certificates: {', '.join(f'{name} ({holder.role})' for name, holder in holders.items())}")
    cameras = {holder.camera for holder in holders.values()}
    for camera in rig.config.cameras:
        if camera not in cameras:
            remedy = f"rhot keys add camera-{camera} --role camera --camera {camera} --rig {as_argument(rig.path)}"
            yield Finding("bad", f"camera {camera} has no certificate and cannot take part", remedy)
    # Before a certificate ends.
    soon = (dt.datetime.now(dt.UTC) + dt.timedelta(days=90)).date().isoformat()
    ending = [f"{name} on {holder.expires}" for name, holder in holders.items() if "" < holder.expires < soon]
    if ending:
        yield Finding("warn", f"certificates end: {', '.join(ending)}", "move the folder away and make new ones")
