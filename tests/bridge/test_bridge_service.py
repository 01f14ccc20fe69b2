"""Bridges on a real bus."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from bridged import poses as bridge_poses
from bridged.readers import messages
from bus_watch import PATIENCE_S, until, wait_for_status
from click.testing import CliRunner
from running.doubling_service import has_refused
from websockets.asyncio.client import connect

from rhot.bus import Bus
from rhot.errors import ConfigError, RhotError
from rhot.messages import Control, HandPose, ObjectPose, Side, Space, encode, encoding_of
from rhot.rig import BridgeConfig, BusConfig
from rhot.service import configuration, runner
from rhot.service.clock_sync import serve_clock
from rhot_bridge.command import bridge
from rhot_bridge.feed import Feed
from rhot_bridge.output import make_output
from rhot_bridge.service import BridgeService, serve_bridges
from rhot_bridge.targets.openxr import HANDS, MEASURED


@pytest.fixture(autouse=True)
def quick_status(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "_STATUS_INTERVAL_S", 0.05)


class FakeRig:
    """Publishes both hands at 60 Hz, and the floor once, before anybody listens."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._stage = bus.publisher("rhot/space/stage", Space)
        self._hands = {side: bus.publisher(f"rhot/hand/{side}", HandPose) for side in ("left", "right")}
        self.still = False

    def know_floor(self) -> None:
        self._stage.put(bridge_poses.stage_message(1))

    async def run(self) -> None:
        control = self._bus.publisher("rhot/control", Control, reliable=True)
        assert await control.wait_for_reader(PATIENCE_S)
        now_ns = time.time_ns()
        control.put(Control(t_ns=now_ns, action="start", session="one", start_t_ns=now_ns))
        while True:
            t_ns = time.time_ns()
            for side, publisher in self._hands.items():
                if not self.still:
                    publisher.put(bridge_poses.hand_message("flat", side, t_ns))  # type: ignore[arg-type]
            await asyncio.sleep(1 / 60)


@asynccontextmanager
async def running(
    router: BusConfig, bridges: dict[str, dict[str, object]], *, floor: bool = True
) -> AsyncIterator[tuple[Bus, FakeRig]]:
    configs = {name: BridgeConfig.model_validate(config) for name, config in bridges.items()}
    async with await Bus.open(router) as bus:
        serve_clock(bus)
        rig = FakeRig(bus)
        if floor:
            rig.know_floor()
        tasks = [asyncio.create_task(serve_bridges(configs, router)), asyncio.create_task(rig.run())]
        try:
            yield bus, rig
        finally:
            begun = time.monotonic()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            assert time.monotonic() - begun < 10.0


async def frames(port: int) -> AsyncIterator[dict[str, object]]:
    """Frames of a WebSocket that may not be open yet."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                async with connect(f"ws://127.0.0.1:{port}") as socket_:
                    async for text in socket_:
                        yield json.loads(text)
            except OSError:
                await asyncio.sleep(0.02)


async def test_hands_come_out_above_the_floor_by_two_bridges_of_one_process(router: BusConfig, free_port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        bridges: dict[str, dict[str, object]] = {
            "page": {"target": "json", "port": free_port},
            "game": {
                "target": "json",
                "transport": "udp",
                "port": receiver.getsockname()[1],
                "axes": "unity",
            },
        }
        async with running(router, bridges) as (bus, _):
            async for frame in frames(free_port):
                hands = {hand["side"]: hand for hand in frame["hands"]}  # type: ignore[attr-defined]
                if len(hands) == 2:
                    break
            for side, hand in hands.items():
                wanted = bridge_poses.hand("flat", side).positions
                assert np.abs(np.array(hand["positions"]).reshape(26, 3) - wanted).max() < 2e-5
            loop = asyncio.get_running_loop()
            while len((unity := json.loads(await loop.sock_recv(receiver, 65536)))["hands"]) < 2:
                pass
            depth = np.array(unity["hands"][0]["positions"])[2::3]
            assert unity["axes"] == "unity"
            assert (depth > 0.2).all()
            found = await wait_for_status(bus, "bridge/game", lambda each: each.rates.get("output", 0.0) > 20.0)
            assert found.problem == ""
            assert {"p50", "p99"} <= set(found.latency_s["output_age"])
            # Nobody reads the page any more: its bridge is there, and idles.
            await wait_for_status(
                bus, "bridge/page", lambda each: each.rates.get("output", 0.0) == 0.0 and each.problem == ""
            )


async def test_hands_of_the_bus_are_in_openxrs_memory(
    router: BusConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "hands"
    monkeypatch.setenv("RHOT_HANDS", str(file))
    async with running(router, {"vr": {"target": "openxr"}}) as (bus, _):
        await wait_for_status(bus, "bridge/vr", lambda each: each.rates.get("output", 0.0) > 20.0)

        def hands() -> np.void:
            found: np.void = np.frombuffer(file.read_bytes(), HANDS, 1)[0]["hands"]
            return found

        sides: tuple[Side, Side] = ("left", "right")
        for number, side in enumerate(sides):
            hand = hands()[number]
            assert hand["state"] == MEASURED
            assert np.abs(hand["joints"]["position"] - bridge_poses.hand("flat", side).positions).max() < 1e-6
            assert 0 <= time.monotonic_ns() - int(hand["t_ns"]) < PATIENCE_S * 1e9
        # Moved while it runs, as people do with the headset on.
        before = hands()[1]["joints"]["position"][0]
        await bus.put(
            "rhot/config/bridge/vr", json.dumps({"offset": [0.0, 0.1, 0.0, 0.0]}).encode(), "application/json"
        )
        await until(lambda: abs(hands()[1]["joints"]["position"][0][1] - before[1] - 0.1) < 1e-6)


async def test_both_hands_of_a_moment_are_one_frame(router: BusConfig, free_port: int) -> None:
    # Frames of the same moment come again where the machine is slow: moments count, not frames.
    seen: set[object] = set()
    repeated = 0
    async with running(router, {"page": {"target": "json", "port": free_port}}) as (bus, _):
        async for frame in frames(free_port):
            if len(frame["hands"]) == 2:  # type: ignore[arg-type]
                repeated += frame["t"] in seen
                seen.add(frame["t"])
            if len(seen) > 50:
                break
        found = await wait_for_status(bus, "bridge/page", lambda each: "to_wire" in each.latency_s)
        assert found.counts["output"] <= found.counts["input"] / 2 + 60 + repeated


async def test_what_stands_on_a_key_that_is_not_its_own_reaches_no_program(router: BusConfig, free_port: int) -> None:
    async with running(router, {"page": {"target": "json", "port": free_port}}) as (bus, _):
        async for frame in frames(free_port):
            if len(frame["hands"]) == 2:  # type: ignore[arg-type]
                break
        for key in ("rhot/hand/up", "rhot/hand/left", "rhot/object/a b"):
            before = (await wait_for_status(bus, "bridge/page", lambda _: True)).counts.get("invalid", 0)
            t_ns = time.time_ns()
            if key.startswith("rhot/hand"):
                message: HandPose | ObjectPose = bridge_poses.hand_message("fist", "right", t_ns)
            else:
                pose = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
                message = ObjectPose(t_ns=t_ns, frame="rig", position=pose[0], orientation=pose[1], state="measured")
            async with asyncio.timeout(PATIENCE_S):
                # Again until it is read: the rig's own hand on the same key may have replaced it.
                while not has_refused(before + 1, await wait_for_status(bus, "bridge/page", lambda _: True)):
                    await bus.put(key, encode(message), encoding_of(type(message)))
                    await asyncio.sleep(0.05)
        async for frame in frames(free_port):
            assert frame["objects"] == []
            break


async def test_without_a_floor_nothing_is_sent_and_it_is_said_once(
    router: BusConfig, free_port: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "rhot_bridge")
    async with running(router, {"page": {"target": "json", "port": free_port}}, floor=False) as (bus, rig):
        async with asyncio.timeout(PATIENCE_S):
            while True:
                try:
                    reader = await connect(f"ws://127.0.0.1:{free_port}")
                    break
                except OSError:
                    await asyncio.sleep(0.02)
        found = await wait_for_status(bus, "bridge/page", lambda each: "no floor" in each.problem)
        assert "rhot calibrate stage" in found.problem
        assert "--axes rig" in found.problem
        await until(lambda: any("no floor" in record.message for record in caplog.records))
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(reader.recv(), 0.5)
        assert sum("no floor" in record.message for record in caplog.records) == 1
        rig.know_floor()
        assert json.loads(await asyncio.wait_for(reader.recv(), PATIENCE_S))["axes"] == "stage"
        await wait_for_status(bus, "bridge/page", lambda each: each.problem == "")
        await reader.close()


async def test_fingers_of_an_avatar_need_no_floor(router: BusConfig) -> None:
    """They turn against their hand; the floor, once known, changes nothing but adds what stands on it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        loop = asyncio.get_running_loop()
        port = receiver.getsockname()[1]

        async def bones() -> bytes:
            while True:
                packet = await asyncio.wait_for(loop.sock_recv(receiver, 65536), PATIENCE_S)
                if b"/VMC/Ext/Bone/Pos" in packet:
                    return packet

        async with running(router, {"avatar": {"target": "vmc", "port": port}}, floor=False) as (bus, rig):
            assert b"IndexProximal" in await bones()
            await wait_for_status(bus, "bridge/avatar", lambda each: each.rates.get("output", 0.0) > 0)
            found = await wait_for_status(bus, "bridge/avatar", lambda each: True)
            assert found.problem == ""
            rig.know_floor()
            assert b"IndexProximal" in await bones()


async def test_a_hand_that_is_gone_fades_and_then_is_not_sent(router: BusConfig, free_port: int) -> None:
    weights: list[float] = []
    async with running(router, {"page": {"target": "json", "port": free_port, "axes": "rig"}}) as (_, rig):
        async for frame in frames(free_port):
            hands = frame["hands"]
            if hands and len(weights) == 0:
                rig.still = True
            if rig.still and not hands:
                break
            if hands:
                weights.append(hands[0]["weight"])  # type: ignore[index]
    fading = [weight for weight in weights if weight < 1.0]
    assert len(fading) > 8
    assert fading == sorted(fading, reverse=True)


async def test_devices_of_steamvr_are_off_when_the_bridge_has_ended(router: BusConfig) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        heard: list[bytes] = []

        def modes() -> dict[object, object]:
            with contextlib.suppress(BlockingIOError):
                while True:
                    heard.append(receiver.recv(65536))
            drivers = [values for address, values in messages(heard) if address == "/VMT/Room/Driver"]
            return {values[0]: values[1] for values in drivers}

        async with running(router, {"vr": {"target": "vmt", "port": receiver.getsockname()[1]}}):
            await until(lambda: modes() == {0: 5, 1: 6})
        assert modes() == {0: 0, 1: 0}


async def test_rate_and_policy_can_change_while_it_runs_and_the_port_cannot() -> None:
    service = BridgeService("page", BridgeConfig(target="json", axes="rig"), Feed())
    service.reconfigure(configuration.changed(service.config, {"rate_hz": 30.0, "absent": "keep"}))
    assert service.config.rate_hz == 30.0
    with pytest.raises(ConfigError, match="port: fixed while the bridge runs"):
        service.reconfigure(configuration.changed(service.config, {"port": 9}))


async def test_a_setting_without_a_meaning_is_refused() -> None:
    for target, setting in (("vmc", {"axes": "unity"}), ("vrchat", {"transport": "udp"}), ("json", {"body": "arms"})):
        with pytest.raises(ConfigError, match=f"^{next(iter(setting))} means nothing to {target}, only to "):
            make_output(BridgeConfig.model_validate({"target": target, **setting}))
    for words in (["vmc", "--axes", "stage"], ["vmt", "--height-m", "1.7"], ["json", "--body", "fingers"]):
        with pytest.raises(ConfigError, match=f"^bridge {words[0]}: .* means nothing to {words[0]}"):
            CliRunner().invoke(bridge, words, standalone_mode=False, catch_exceptions=False)


def test_the_command_says_what_there_is(tmp_path: object) -> None:
    run = CliRunner().invoke
    assert "JSON by WebSocket" in run(bridge, ["--help"]).output
    nothing = run(bridge, [])
    assert nothing.exit_code == 2
    assert "which program? one of vmc, vrchat, vmt, json" in nothing.output
    with pytest.raises(ConfigError, match=r"^bridge vmc: host: not the name or address of a machine"):
        run(bridge, ["vmc", "--host", "a..b"], catch_exceptions=False)
    unknown = run(bridge, ["teapot"])
    assert unknown.exit_code == 2
    assert "there is no bridge to 'teapot'" in unknown.output


def test_the_command_takes_bridges_of_the_rig(rig_folder: object, monkeypatch: pytest.MonkeyPatch) -> None:
    from pathlib import Path

    from rhot_bridge import command

    toml = Path(str(rig_folder)) / "rig.toml"
    toml.write_text(toml.read_text() + '\n[bridges.desk]\ntarget = "json"\nport = 4000\n')
    asked: list[dict[str, BridgeConfig]] = []

    async def note(bridges: dict[str, BridgeConfig], _: BusConfig) -> int:
        asked.append(bridges)
        return 0

    monkeypatch.setattr(command, "serve_bridges", note)
    for words in ([], ["desk", "--rate-hz", "30"], ["json", "--axes", "unity"]):
        done = CliRunner().invoke(bridge, [*words, "--rig", str(rig_folder)], standalone_mode=False)
        assert done.exception is None, done.exception
    assert [list(each) for each in asked] == [["desk"], ["desk"], ["json"]]
    assert (asked[0]["desk"].rate_hz, asked[1]["desk"].rate_hz, asked[1]["desk"].port) == (90.0, 30.0, 4000)
    assert asked[2]["json"].axes == "unity"
    toml.write_text(toml.read_text() + "rate = 1\n")
    with pytest.raises(RhotError, match=r"bridges\.desk\.rate"):
        CliRunner().invoke(bridge, ["--rig", str(rig_folder)], standalone_mode=False, catch_exceptions=False)
