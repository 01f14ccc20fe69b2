"""`compose.yaml` by a real container engine: built, started, looked into, one service restarted, stopped.

Where the official images cannot be fetched, Debian's Python stands in for the one, and `rhot router` for zenohd.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from machine.engine import Engine, EngineRefusedError, container_engine, make_python_image

from rhot.bus import Bus
from rhot.errors import BusError
from rhot.messages import HandPose, decode
from rhot.rig import BusConfig

pytestmark = pytest.mark.stacks

REPOSITORY = Path(__file__).parents[2]
COMPOSE = REPOSITORY / "deploy" / "compose.yaml"
CACHE = Path(os.environ.get("RHOT_STACKS", REPOSITORY / ".stacks")) / "docker"
ROUTER_STAND_IN = """\
FROM {rhot}
USER root
RUN printf '#!/bin/sh\\nexec rhot router --listen tcp/0.0.0.0:7447\\n' > /usr/local/bin/zenohd
RUN chmod +x /usr/local/bin/zenohd
USER rhot
ENTRYPOINT ["zenohd"]
"""


class Rig:
    """The containers of compose.yaml."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.services: dict[str, Any] = yaml.safe_load(COMPOSE.read_text())["services"]
        second = engine.run("docker", "compose", "version", check=False).returncode == 0
        file = COMPOSE if second else _for_first_compose()
        program = ["docker", "compose"] if second else ["docker-compose"]
        self.command = [*program, "-p", "rhot-stacks", "--project-directory", str(COMPOSE.parent), "-f", str(file)]

    def compose(self, *arguments: str, check: bool = True) -> str:
        done = self.engine.run(*self.command, *arguments, check=check)
        return done.stdout

    def inside(self, service: str, *command: str, check: bool = True) -> str:
        return self.compose("exec", "-T", service, *command, check=check)

    def states(self) -> dict[str, str]:
        """Service to health, or to state where it has no health check."""
        found = {}
        for container in self.compose("ps", "-q").split():
            told = json.loads(self.engine.run("docker", "inspect", container).stdout)[0]
            service = told["Config"]["Labels"]["com.docker.compose.service"]
            found[service] = told["State"].get("Health", {}).get("Status") or told["State"]["Status"]
        return found


def _for_first_compose() -> Path:
    """Return a copy without the project's name, which the first Compose (Debian 12) does not know."""
    CACHE.mkdir(parents=True, exist_ok=True)
    copy = CACHE / "compose.yaml"
    copy.write_text(COMPOSE.read_text().replace("\nname: rhot\n", "\n"))
    return copy


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    """The whole simulated rig, running."""
    try:
        with container_engine(CACHE) as engine:
            made = Rig(engine)
            python = re.search(r"ARG PYTHON_IMAGE=(\S+)", (REPOSITORY / "deploy" / "Dockerfile").read_text())
            assert python is not None
            if not engine.has(python[1]):
                make_python_image(engine, python[1])
            image = re.sub(r"\$\{\w+:-(.*?)\}", r"\1", made.services["fusion"]["image"])
            engine.run(
                *("docker", "build", "--network", "host", "--file", str(REPOSITORY / "deploy" / "Dockerfile")),
                *("--tag", image, str(REPOSITORY)),
            )
            router = re.sub(r"\$\{\w+:-(.*?)\}", r"\1", made.services["router"]["image"])
            if not engine.has(router):
                (CACHE / "router").mkdir(parents=True, exist_ok=True)
                (CACHE / "router" / "Dockerfile").write_text(ROUTER_STAND_IN.format(rhot=image))
                engine.run("docker", "build", "--network", "host", "--tag", router, str(CACHE / "router"))
            made.compose("up", "--detach", "--no-build")
            try:
                yield made
            finally:
                made.compose("down", "--volumes", "--timeout", "10", check=False)
    except EngineRefusedError as refused:
        pytest.skip(str(refused))


def test_all_services_become_healthy(rig: Rig) -> None:
    wanted = {name for name, service in rig.services.items() if "profiles" not in service and name != "rig"}
    deadline = time.monotonic() + 240.0
    while True:
        states = rig.states()
        ready = {name for name in wanted if states.get(name) in ("healthy", "running")}
        starting = {name for name, state in states.items() if state == "starting"}
        if ready == wanted and not starting:
            return
        assert time.monotonic() < deadline, states
        time.sleep(3.0)


async def hands(count: int) -> list[HandPose]:
    """Return so many hands that are measured, from the host."""
    found = []
    async with await Bus.open(BusConfig(connect=("tcp/127.0.0.1:7447",)), timeout_s=20.0) as bus:
        async for sample in bus.latest("rhot/hand/right"):
            pose = decode(sample.payload, HandPose)
            if pose.state == "measured":
                found.append(pose)
            if len(found) == count:
                break
    return found


async def test_a_hand_is_tracked_and_seen_from_the_host(rig: Rig) -> None:
    poses = await hands(50)
    assert len({pose.t_ns for pose in poses}) == 50
    assert len(poses[-1].joints) == 26


def test_what_the_docs_show_works(rig: Rig) -> None:
    status = rig.inside("fusion", "rhot", "status")
    assert {"fusion", "ik", "capture"} <= set(re.findall(r"\b(fusion|ik|capture)\b", status))
    assert "rhot/hand/right" in rig.inside("fusion", "rhot", "get", "rhot/hand/*")


def test_services_are_nobody_and_write_only_where_they_must(rig: Rig) -> None:
    for service in ("fusion", "viewer", "capture-left"):
        assert rig.inside(service, "id", "-u").strip() == "10001"
        assert rig.engine.run(*_exec(rig, service, "touch /usr/x"), check=False).returncode != 0
    assert rig.engine.run(*_exec(rig, "fusion", "touch /rig/x"), check=False).returncode != 0
    rig.inside("viewer", "sh", "-c", "touch /rig/x /recordings/x && rm /rig/x /recordings/x")


def _exec(rig: Rig, service: str, command: str) -> list[str]:
    return ["docker", "exec", rig.compose("ps", "-q", service).strip(), "sh", "-c", command]


async def test_a_service_that_dies_comes_back_and_tracking_goes_on(rig: Rig) -> None:
    rig.engine.run(*_exec(rig, "fusion", "kill -9 $(cat /proc/1/task/1/children)"), check=False)
    poses = await hands(20)
    assert len(poses) == 20
    rig.compose("restart", "ik")
    assert len(await hands(20)) == 20


async def test_with_certificates_the_rig_tracks_and_strangers_see_nothing(rig: Rig) -> None:
    rig.compose("down", "--volumes", "--timeout", "10")
    rig.command += ["-f", str(COMPOSE.with_name("compose.secure.yaml"))]
    rig.compose("up", "--detach", "--no-build")
    deadline = time.monotonic() + 180.0
    while '"measured"' not in rig.inside("fusion", "rhot", "get", "rhot/hand/right", check=False):
        assert time.monotonic() < deadline, rig.compose("logs", "--tail", "20")
        await asyncio.sleep(3.0)
    for transport in ("tcp", "tls"):
        with pytest.raises(BusError):
            await Bus.open(BusConfig(connect=(f"{transport}/127.0.0.1:7447",)), timeout_s=5.0)


def test_the_stop_is_clean_and_quick(rig: Rig) -> None:
    begun = time.monotonic()
    rig.compose("stop", "--timeout", "10")
    assert time.monotonic() - begun < 45.0
    for container in rig.compose("ps", "-q").split():
        told = json.loads(rig.engine.run("docker", "inspect", container).stdout)[0]
        service = told["Config"]["Labels"]["com.docker.compose.service"]
        # 137: killed, because it had not ended by itself.
        assert told["State"]["ExitCode"] != 137, service
