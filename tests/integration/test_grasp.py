"""The page Grasp in a real browser with an emulated headset, beside a rig whose services are stubbed."""

from __future__ import annotations

import json
import math
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
import things
from page.browser import CHROMIUM, Browser, open_browser, wait_until
from page.viewer_process import ViewerProcess
from stub_rig import StubRig, StubThread
from wall_clock import figures_in_time, in_time

from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.bus import Bus
from rhot.geometry.rotations import (
    inverse,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
    rotation_from_vector,
)
from rhot.messages import HandPose, HeadPose, ObjectPose, decode
from rhot.object_mesh import mesh_file
from rhot.rig import BusConfig, RegistrationFile, load_rig, write_json_model
from rhot.rig.calibration import RigidTransform
from rhot.rig.folder import REGISTRATION_FILE, RIG_FILE, registration_name
from rhot.service.clock_sync import serve_clock
from rhot_calibration.objects.fit import Places, first_prior, fit_registration
from rhot_sim.rig.folder import write_simulated_rig
from rhot_sim.running.processes import free_endpoint
from rhot_viewer.grasp.files import is_built
from rhot_viewer.grasp.hello import stage_of

EMULATOR: Final = Path(__file__).parents[2] / "web" / "node_modules" / "iwer" / "build" / "iwer.min.js"
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (Debian: apt install chromium)"),
    pytest.mark.skipif(not is_built(), reason="the page Grasp is not built: make web (needs node and npm)"),
    pytest.mark.skipif(not EMULATOR.exists(), reason="no emulated headset: make web installs it"),
]

HEADSET: Final = (
    "window.device = new IWER.XRDevice(IWER.metaQuest3); device.installRuntime({forceInstall: true}); "
    "device.controllers.right.connected = true;"
    # It calls its controllers' positions emulated, as a real headset does of one that it has lost out of sight.
    "const grip = device.controllers.right.inputSource.gripSpace;"
    "for (const key of Object.getOwnPropertySymbols(grip)) "
    "if ('emulated' in (grip[key] ?? {})) grip[key].emulated = false;"
)
T_RIG_WEBXR: Final = rigid(
    rotation_from_vector(np.array([1.9, 0.4, -0.3])) @ rotation_from_vector(np.array([0.0, 0.7, 0.0])),
    np.array([0.25, -0.4, 1.6]),
)
"""Where the emulated headset's floor really lies in the rig."""
LEVER_M: Final = np.array([0.01, 0.03, -0.02])
"""Where the painted marker sits on the controller."""
MARKER_NOISE_M: Final = 0.0005
"""Of a marker that is held still, each axis."""
ALIKE_M: Final = 1e-4


class Rig(ViewerProcess):
    """A rig without cameras, and the page beside it."""

    def __init__(self, folder: Path, port: int, bus: Bus) -> None:
        arguments = ["--xr", "--rig", str(folder), "--other-page", "http://localhost:1"]
        super().__init__(arguments, port, folder / "grasp.log")
        self.folder = folder
        self.bus = bus


@pytest.fixture
def stubbed(tmp_path: Path) -> Iterator[tuple[StubRig, str]]:
    """A hand that stands still, and where its router listens."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    folder = tmp_path / "rig"
    folder.mkdir()
    write_simulated_rig(folder, endpoint=endpoint)
    with (folder / RIG_FILE).open("a") as file:
        file.writelines(f'\n[objects.{name}]\nsource = "webxr"\n' for name in ("head", "controller"))
        file.write(
            '\n[objects.cup]\nsource = "recorded"\npath = "cup.csv"\n'
            'shape = { kind = "mesh", file = "cup.glb", scale = 0.001 }\n'
        )
    things.save(things.mug(), folder / "cup.glb", scale=1000.0)
    (folder / REGISTRATION_FILE).unlink(missing_ok=True)
    with StubThread(folder, endpoint) as stub:
        stub.still = True
        yield stub, endpoint


@pytest.fixture
async def rig(stubbed: tuple[StubRig, str], free_port: int) -> AsyncIterator[Rig]:
    """The rig with its clock and its page."""
    stub, endpoint = stubbed
    async with await Bus.open(BusConfig(connect=(endpoint,)), timeout_s=30.0) as bus:
        serve_clock(bus)
        made = Rig(stub.rig.path, free_port, bus)
        try:
            made.start()
            yield made
        finally:
            made.kill()


@contextmanager
def headset_browser(url: str) -> Iterator[Browser]:
    with open_browser("about:blank", 480, 320) as browser:
        browser.command("Page.addScriptToEvaluateOnNewDocument", source=EMULATOR.read_text() + HEADSET)
        browser.navigate(url)
        yield browser


def drawn(browser: Browser) -> FloatArray:
    """The joints (26, 3) that are drawn, metres, in the space of desktop or headset."""
    browser.wait_for("window.rhot?.bones('right') && rhot.drawn.right")
    return np.array(browser.evaluate("rhot.bones('right')"))


def place(browser: Browser, device: str, T: FloatArray) -> None:
    x, y, z = T[:3, 3].tolist()
    q = quaternion_from_rotation(T[:3, :3]).tolist()
    browser.evaluate(f"{device}.position.set({x}, {y}, {z}); {device}.quaternion.set({', '.join(map(str, q))}); 1")


async def newest(rig: Rig, key: str, model: Any) -> Any:
    for reply in await rig.bus.get(key):
        if not reply.error:
            return decode(reply.payload, model)
    return None


async def published(rig: Rig, key: str, model: type[ObjectPose], after_ns: int) -> FloatArray:
    """The pose (4, 4) on a key that was true after a moment, rig frame."""
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        pose = await newest(rig, key, model)
        if pose is not None and pose.t_ns > after_ns:
            return rigid(rotation_from_quaternion(np.array(pose.orientation)), np.array(pose.position))
    raise AssertionError(f"nothing new on {key}")


def ten_places() -> list[FloatArray]:
    random = np.random.default_rng(4)
    return [
        rigid(
            rotation_from_vector(random.uniform(-0.8, 0.8, 3)),
            np.array([0.0, 1.0, -0.3]) + random.uniform(-0.2, 0.2, 3),
        )
        for _ in range(10)
    ]


async def register(rig: Rig, browser: Browser) -> FloatArray:
    """Hold the controller at ten places, and return the T_rig_webxr that follows."""
    random = np.random.default_rng(5)
    devices = []
    for T in ten_places():
        place(browser, "device.controllers.right", T)
        # One frame later the page has seen it.
        frames = browser.evaluate("rhot.frames")
        browser.wait_for(f"rhot.frames > {frames} + 1")
        devices.append(await published(rig, "rhot/object/controller", ObjectPose, time.time_ns()))
    R, p = np.array([T[:3, :3] for T in devices]), np.array([T[:3, 3] for T in devices])
    markers = (T_RIG_WEBXR @ np.array([T @ np.append(LEVER_M, 1.0) for T in devices])[..., None])[:, :3, 0]
    places = Places(
        tuple(f"place {number}" for number in range(10)),
        markers + random.normal(0.0, MARKER_NOISE_M, (10, 3)),
        np.full(10, MARKER_NOISE_M),
        R,
        p,
    )
    estimate = fit_registration(places, first_prior(places, np.zeros(3), 0.05)).estimate
    return rigid(estimate.R_rig_tracker, estimate.t_rig_tracker)


async def test_the_hand_is_where_the_rig_says_on_desktop_and_in_a_headset(
    rig: Rig, stubbed: tuple[StubRig, str]
) -> None:
    stub, _ = stubbed
    with headset_browser(rig.url) as browser:
        hand = await newest_hand(rig)
        T_stage_rig = inverse(stage_of(stub.rig)[0])
        assert apart_m(drawn(browser), T_stage_rig, hand) < ALIKE_M
        assert browser.evaluate("document.getElementById('other').href") == "http://localhost:1/"
        a_cup_is_drawn_to_scale(rig, browser)
        browser.evaluate("document.getElementById('truth').click()")
        browser.wait_for("/fingertips 2\\.0 mm from the truth/.test(document.getElementById('state').textContent)")

        browser.click_text("Enter with the headset")
        browser.wait_for("rhot.headset.on")
        head = rigid(rotation_from_vector(np.array([-0.4, 0.2, 0.0])), np.array([0.1, 1.3, 0.2]))
        place(browser, "device", head)
        wait_until(lambda: browser.evaluate("rhot.frames") > 5, "frames")
        # What the page says in HTML stands in the scene here.
        signs = browser.wait_for("rhot.signs.texts.length > 2 && rhot.signs.texts")
        assert {"tracked right hand", "a ball that exists only here"} <= set(signs)
        T_rig_webxr = await register(rig, browser)
        off = inverse(T_RIG_WEBXR) @ T_rig_webxr
        desk = np.array([0.0, 1.0, -0.3, 1.0])
        assert np.linalg.norm((off @ desk - desk)[:3]) < 2e-3
        assert np.degrees(np.arccos(min(1.0, (np.trace(off[:3, :3]) - 1.0) / 2.0))) < 0.3

        # As `rhot calibrate objects` writes it; the page takes it while it runs.
        q = quaternion_from_rotation(T_rig_webxr[:3, :3]).tolist()
        x, y, z = T_rig_webxr[:3, 3].tolist()
        write_json_model(
            rig.folder / registration_name("webxr"),
            RegistrationFile(T_rig_tracker=RigidTransform(position=(x, y, z), orientation=(q[0], q[1], q[2], q[3]))),
        )
        browser.wait_for("rhot.rig.webxr !== null")
        frames = browser.evaluate("rhot.frames")
        browser.wait_for(f"rhot.frames > {frames} + 1")
        assert apart_m(drawn(browser), inverse(T_rig_webxr), hand) < ALIKE_M
        seen = await published(rig, "rhot/head", HeadPose, time.time_ns())
        assert seen == pytest.approx(T_rig_webxr @ head, abs=1e-5)
        assert browser.errors == []

        rig.stop()
        browser.wait_for("!rhot.link.connected")
        rig.start()
        browser.wait_for("rhot.link.connected && rhot.link.connections === 2")
        assert apart_m(drawn(browser), inverse(T_rig_webxr), hand) < ALIKE_M
        assert [error for error in browser.errors if "ERR_CONNECTION_REFUSED" not in error] == []
    rig.stop()


def a_cup_is_drawn_to_scale(rig: Rig, browser: Browser) -> None:
    """Its surface comes from the rig folder's file, in millimetres and off its origin there."""
    shape = mesh_file(rig.folder / "cup.glb", 0.001).shape
    cup = {"state": "measured", "pose": [0.1, 0.0, 0.6, 0.0, 0.0, 0.0, 1.0], "shape": shape.model_dump()}
    tell = f"rhot.rig.frame({{'rhot/object/cup': {{t: rhot.t, ...{json.dumps(cup)}}}}})"
    drawn_cup = browser.wait_for(f"({tell}, rhot.drawnThing('cup')?.model && rhot.drawnThing('cup'))")
    T_stage_rig = inverse(stage_of(load_rig(rig.folder))[0])
    assert drawn_cup["middle"] == pytest.approx((T_stage_rig @ [0.1, 0.0, 0.6, 1.0])[:3], abs=1e-4)
    assert drawn_cup["size"] == pytest.approx(np.abs(T_stage_rig[:3, :3]) @ shape.size, abs=2e-4)


RECORD: Final = """(() => {
    window.lifts = [];
    let last = -1;
    setInterval(() => {
        if (rhot.frames !== last && rhot.twins.cube) window.lifts.push([rhot.t, rhot.twins.cube[1]]);
        last = rhot.frames;
    }, 5);
    return true;
})()"""
CARRYING_FROM_S: Final = 7.0
"""The scripted hand of the simulated world lifts its object half a second later, and has put it down 3.2 s later."""
TWIN_LATE_S: Final = 0.1
TWIN_OFF_M: Final = 0.003
"""Beside what 0.1 s explain: a pose that is carried on overshoots a little where the truth turns."""


@pytest.mark.real_time
async def test_the_twin_is_lifted_and_put_down_when_the_truth_is(rig: Rig, stubbed: tuple[StubRig, str]) -> None:
    stub, _ = stubbed
    T_stage_rig = inverse(stage_of(stub.rig)[0])

    def true_heights(t_s: FloatArray) -> FloatArray:
        places = [stub.world.truth(float(t), 0).objects["cube"].position for t in t_s]
        return np.array([(T_stage_rig @ np.append(place, 1.0))[1] for place in places])

    with open_browser(rig.url, 320, 240) as browser:
        browser.wait_for("rhot.twins?.cube && rhot.frames > 10 && rhot.link.clock.ready")
        lying = float(true_heights(np.array([1.0]))[0])
        stub.play_from(CARRYING_FROM_S)
        stub.still = False
        begun_ms = time.time() * 1e3
        browser.evaluate(RECORD)
        browser.wait_for(f"lifts.at(-1)?.[0] > {begun_ms + 4000}")
        seen = np.array(browser.evaluate("lifts"))
        clock_ms = browser.evaluate("rhot.link.clock.uncertainty")
        assert browser.errors == []
    seen = seen[seen[:, 0] > begun_ms + 200.0]
    t_s, heights = seen[:, 0] / 1e3 - stub.zero_ns / 1e9, seen[:, 1]
    slow_s = float(np.diff(t_s).max())
    in_time(slow_s, 0.5, "a picture of the page")
    in_time(clock_ms, 50.0, "how well the page knows the clock", "ms")
    assert heights.max() > lying + 0.09, "it was lifted"
    assert heights[-1] == pytest.approx(lying, abs=TWIN_OFF_M), "and put down"
    around = t_s[:, None] + np.linspace(-TWIN_LATE_S, TWIN_LATE_S, 21)
    true = true_heights(around.ravel()).reshape(around.shape)
    off = np.maximum(true.min(axis=1) - heights, heights - true.max(axis=1))
    late = off > TWIN_OFF_M
    figures_in_time(
        {f"{late.sum()} of {len(off)} pictures show the twin more than 0.1 s off": math.inf} if late.any() else {}
    )


async def newest_hand(rig: Rig) -> FloatArray:
    """The joints (26, 4) of the hand on the bus, homogeneous, metres, rig frame."""
    hand = await newest(rig, "rhot/hand/right", HandPose)
    return np.array([(*hand.joints[name].position, 1.0) for name in JOINTS])


def apart_m(joints: FloatArray, T: FloatArray, hand: FloatArray) -> float:
    """The largest distance between joints that are drawn and those on the bus."""
    return float(np.linalg.norm(joints - (hand @ T.T)[:, :3], axis=1).max())
