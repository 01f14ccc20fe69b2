"""Real processes over a real router: any order of start, any death, garbage, plain queries."""

from __future__ import annotations

import asyncio
import json
import sys
import time
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zenoh
from bus_watch import PATIENCE_S, answers
from running.rig_processes import Processes, hand_measured_after, next_message, start_rig
from wall_clock import in_time

from rhot.anatomy.skeleton import FINGERS
from rhot.bus import Bus
from rhot.messages import HandPose, MarkerFrame, Message, ServiceStatus, decode
from rhot.rig import load_rig
from rhot_sim.world.world import World

pytestmark = pytest.mark.integration

UP_S = 20.0
BACK_S = 3.0


async def run_rhot(*arguments: str) -> tuple[int, str, str]:
    """Run a command of ours; return exit code, output, errors."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "rhot", *arguments, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    async with asyncio.timeout(PATIENCE_S):
        output, errors = await process.communicate()
    assert process.returncode is not None
    return process.returncode, output.decode(), errors.decode()


@pytest.mark.real_time
@pytest.mark.parametrize("simulated_rig", ["still"], indirect=True)
async def test_any_order_any_death(processes: Processes, rig_bus: Bus) -> None:
    """Services find each other whatever comes first; each may be killed and the hand is back within three seconds.

    The hand is still: of one that grasps, fingers are hidden for longer than that.
    """
    for name in ("ik", "capture right", "truth", "objects"):
        await processes.start(name)
    await asyncio.sleep(1.0)
    await processes.start("fusion")
    control = await start_rig(rig_bus)
    await processes.start("capture left")
    in_time(await hand_measured_after(rig_bus, control.start_t_ns), UP_S, "the first hand")
    for name in ("capture left", "fusion", "ik", "router", "capture right", "objects"):
        await processes.kill(name)
        killed_ns = time.time_ns()
        begun = time.monotonic()
        await processes.start(name)
        try:
            await hand_measured_after(rig_bus, killed_ns)
        except TimeoutError:
            pytest.fail(f"no hand after {name} was killed\n{processes.logs()}")
        in_time(time.monotonic() - begun, BACK_S, f"the hand is back after {name} was killed")


async def all_up(processes: Processes, bus: Bus) -> float:
    """Start everything; return the seconds from the start of the session to the first hand."""
    for name in ("fusion", "ik", "capture left", "capture right", "objects", "truth"):
        await processes.start(name)
    control = await start_rig(bus)
    return await hand_measured_after(bus, control.start_t_ns)


KEYS = {
    "rhot/control",
    "rhot/markers/left",
    "rhot/markers/right",
    "rhot/points",
    "rhot/hand/right",
    "rhot/object/cube",
    "rhot/truth",
    "rhot/clock",
    "rhot/preview/left",
    *(f"rhot/{kind}/capture/left" for kind in ("status", "config")),
    *(f"rhot/{kind}/{service}/main" for kind in ("status", "config") for service in ("fusion", "ik", "objects")),
}


@pytest.mark.parametrize("simulated_rig", ["slow"], indirect=True)
async def test_every_key_can_be_looked_at(
    processes: Processes, rig_bus: Bus, simulated_rig: tuple[Path, str], tmp_path: Path
) -> None:
    await all_up(processes, rig_bus)
    rig, endpoint = simulated_rig
    code, output, errors = await run_rhot("get", "rhot/**", "--rig", str(rig))
    assert code == 0, errors
    values = {line["key"]: line["value"] for line in map(json.loads, output.splitlines())}
    assert set(values) >= KEYS
    assert len(values["rhot/hand/right"]["joints"]) == 26
    assert values["rhot/truth"]["objects"]["cube"]["position"][2] > 0.3

    # The same from outside: Zenoh alone, msgpack as it comes and JSON where asked for.
    config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}}))

    def ask() -> tuple[dict[str, bytes], dict[str, bytes]]:
        with zenoh.open(config) as session:
            packed, text = (
                {str(reply.ok.key_expr): reply.ok.payload.to_bytes() for reply in session.get(selector) if reply.ok}
                for selector in ("rhot/hand/**", "rhot/**?format=json")
            )
            return packed, text

    packed, text = await asyncio.to_thread(ask)
    assert msgpack.unpackb(packed["rhot/hand/right"])["side"] == "right"
    assert set(text) >= KEYS
    assert all(json.loads(value) is not None for value in text.values())

    status, watched, doctor = await asyncio.gather(
        run_rhot("status", "--rig", str(rig)),
        run_rhot("watch", "rhot/hand/right", "--count", "3", "--rig", str(rig)),
        run_rhot("doctor", "--rig", str(rig)),
    )
    code, output, _ = status
    assert code == 0
    assert "capture/left" in output
    assert "fusion/main" in output
    code, output, _ = watched
    assert code == 0
    assert [json.loads(line)["key"] for line in output.splitlines()] == ["rhot/hand/right"] * 3
    code, output, _ = doctor
    assert code == 0, output
    assert "services are alive" in output

    for selector in ("rhot/preview/left", "rhot/preview/left?overlay=markers", "rhot/preview/left?mask=thumb"):
        (reply,) = await answers(rig_bus, selector)
        assert reply.encoding == "image/jpeg", reply.error
        assert reply.payload[:2] == b"\xff\xd8"
    (refused,) = await answers(rig_bus, "rhot/preview/left?ovrlay=markers")
    assert "only overlay=markers, mask=<marker> and format= are known" in refused.error
    (refused,) = await answers(rig_bus, "rhot/preview/left?mask=toe")
    assert "thumb" in refused.error, "names the masks that there are"

    wrong, right = await asyncio.gather(
        run_rhot("config", "capture/left", "exposure_s=5", "--rig", str(rig)),
        run_rhot("config", "fusion/main", "hold_s=0.3", "--rig", str(rig)),
    )
    code, _, errors = wrong
    assert code == 2
    assert "exposure_s" in errors
    code, output, errors = right
    assert code == 0, errors
    assert json.loads(output)["hold_s"] == 0.3


@pytest.mark.real_time
# A hand at rest: how much of its way a moving one makes between two frames is the machine's doing, not the garbage's.
@pytest.mark.parametrize("simulated_rig", ["still"], indirect=True)
async def test_garbage_on_every_key_leaves_the_hand_alone(
    processes: Processes, rig_bus: Bus, simulated_rig: tuple[Path, str]
) -> None:
    in_time(await all_up(processes, rig_bus), UP_S, "the first hand")
    world = World.from_rig(load_rig(simulated_rig[0]))
    reply = (await answers(rig_bus, "rhot/control"))[0]  # every service knows it
    start_t_ns = msgpack.unpackb(reply.payload)["start_t_ns"]
    good = {key: msgpack.unpackb((await answers(rig_bus, key))[0].payload) for key in (*MESSAGES, "rhot/control")}
    statuses = await status_of_all(rig_bus)
    mailbox = rig_bus.events("rhot/hand/right")
    stop = asyncio.create_task(throw_garbage(rig_bus, good))
    poses = []
    async with asyncio.timeout(PATIENCE_S):
        async for sample in mailbox:
            try:
                pose = decode(sample.payload, HandPose)
            except Exception:
                continue  # our own garbage on this key
            if 0 < pose.t_ns - start_t_ns < 10**12:  # others are garbage that is valid but for its time
                poses.append(pose)
            if stop.done() and pose.t_ns > stop.result() and len(poses) > 60:
                break
    stop.result()
    errors_m = [
        float(
            np.linalg.norm(
                np.array(pose.joints[f"{finger}_tip"].position) - true.hands["right"][f"{finger}_tip"].position
            )
        )
        for pose in poses
        for true in [world.truth((pose.t_ns - start_t_ns) / 1e9, pose.t_ns)]
        for finger in FINGERS
    ]
    assert len(errors_m) > 250
    assert np.median(errors_m) < 0.004
    assert np.percentile(errors_m, 99) < 0.02, "no pose shows anything of the garbage"
    after = await status_of_all(rig_bus)
    for name in SERVICES:
        assert after[name].state == "running"
        assert after[name].uptime_s > statuses[name].uptime_s, "it is still the same process"
        assert after[name].counts["invalid"] > statuses[name].counts.get("invalid", 0), f"{name} counts what it refused"
    for name, child in processes.running.items():
        assert child.process.returncode is None, f"{name} ended\n{child.tail()}"
        assert "Traceback" not in child.tail()


MESSAGES = ("rhot/markers/left", "rhot/markers/right", "rhot/points", "rhot/hand/right", "rhot/object/cube")


SERVICES = ("capture/left", "fusion/main", "ik/main", "objects/main")


async def status_of_all(bus: Bus) -> dict[str, ServiceStatus]:
    """How the services do from now on: the last value is up to a second old."""
    asked_ns = time.time_ns()

    async def fresh(name: str) -> ServiceStatus:
        key = f"rhot/status/{name}"
        status = await next_message(bus, key, ServiceStatus, lambda message: message.t_ns > asked_ns)
        assert isinstance(status, ServiceStatus)
        return status

    return dict(zip(SERVICES, await asyncio.gather(*map(fresh, SERVICES)), strict=True))


async def throw_garbage(bus: Bus, good: dict[str, dict[str, object]]) -> int:
    """Put garbage on every key for a while; return when it ended."""
    rng = np.random.default_rng(5)
    for _ in range(6):
        now_ns = time.time_ns()
        for key, value in good.items():
            whole = msgpack.packb(value)
            for payload in (
                rng.bytes(int(rng.integers(0, 200))),
                whole[: len(whole) // 2],
                msgpack.packb([value]),
                msgpack.packb(value | {"t_ns": "x"}),
                msgpack.packb(value | {"t_ns": now_ns + 10**13}),
                msgpack.packb(value | {"t_ns": now_ns - 10**13, "start_t_ns": now_ns + 10**14}),
                msgpack.packb(value | {"t_ns": float("nan"), "seq": 2**63}),
                msgpack.packb(
                    value | {"t_ns": 2**63 - 1, "markers": {"thumb": {"u": 1e300}}, "points": 7, "action": "explode"}
                ),
            ):
                await bus.put(key, payload, "application/msgpack")
        for key in (
            "rhot/config/fusion/main",
            "rhot/config/capture/left",
            "rhot/config/ik/main",
            "rhot/config/objects/main",
        ):
            for payload in (rng.bytes(40), b'{"hold_s": -1}', b'{"exposure_s": 99}', b"{}}"):
                await bus.put(key, payload, "application/json")
        await asyncio.sleep(0.1)
    return time.time_ns()


@pytest.mark.real_time
def test_nothing_is_left_running(simulated_rig: tuple[Path, str]) -> None:
    from running.rig_processes import processes_that_name

    assert list(processes_that_name(str(simulated_rig[0]))) == []


@pytest.mark.real_time
async def test_a_camera_runs_without_colours_and_takes_them_over(processes: Processes, rig_bus: Bus) -> None:
    """Colours are calibrated from the running camera's own pictures, so it has to run before there are any."""
    path = processes.rig / "colors.json"
    aside = path.with_suffix(".aside")
    path.rename(aside)
    try:
        await processes.start("fusion")
        await processes.start("capture left")
        await start_rig(rig_bus)

        def empty(message: Message) -> bool:
            assert isinstance(message, MarkerFrame)
            return not message.markers

        await next_message(rig_bus, "rhot/markers/left", MarkerFrame, empty)
        (preview,) = await answers(rig_bus, "rhot/preview/left?format=png")
        assert preview.payload.startswith(b"\x89PNG")
        path.write_text("{}")

        def refused(message: Message) -> bool:
            assert isinstance(message, ServiceStatus)
            return "new colours refused" in message.last_error

        await next_message(rig_bus, "rhot/status/capture/left", ServiceStatus, refused)
    finally:
        aside.replace(path)
    begun = time.monotonic()
    await next_message(rig_bus, "rhot/markers/left", MarkerFrame, lambda message: not empty(message))
    in_time(time.monotonic() - begun, BACK_S + 2.0, "markers in the new colours")
