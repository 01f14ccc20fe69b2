"""`rhot up`: the PC side in one terminal, ended by Ctrl-C at any moment and by a service that cannot run."""

from __future__ import annotations

import asyncio
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from bus_watch import PATIENCE_S, wait_for_status
from running.rig_processes import processes_that_name
from wall_clock import in_time

from rhot.bus import Bus
from rhot.messages import Marker, MarkerFrame, PointSet
from rhot.rig import BusConfig, load_rig
from rhot.rig.template import rig_template
from rhot_sim.running.processes import free_endpoint
from rhot_tools.operate.up import cameras_here

pytestmark = pytest.mark.integration


def make_rig(folder: Path, cameras: tuple[str, ...]) -> Path:
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    text = rig_template(
        folder="rig",
        name="up",
        connect=(endpoint,),
        listen=(endpoint,),
        cameras=cameras,
        camera_xs_m=[0.075 * index for index in range(len(cameras))],
    )
    folder.mkdir()
    (folder / "rig.toml").write_text(text)
    return folder


@pytest.mark.real_time
@pytest.mark.parametrize("wait_for", ["routing on", "session"])
def test_ctrl_c_ends_all_of_it_at_once_whatever_it_is_doing(tmp_path: Path, wait_for: str) -> None:
    rig = make_rig(tmp_path / "rig", ("left", "right"))
    command = [sys.executable, "-m", "rhot", "up", "--no-viewer", "--rig", str(rig)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if wait_for in line:
                break
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
        process.wait(timeout=10)
        took_s = time.monotonic() - begun
    assert process.returncode == 130
    assert "Traceback" not in rest
    assert list(processes_that_name(str(rig))) == []
    in_time(took_s, 2.0, "the end")


@pytest.mark.real_time
def test_a_service_that_cannot_run_ends_it_with_its_reason(tmp_path: Path) -> None:
    rig = make_rig(tmp_path / "rig", ("left",))
    begun = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "rhot", "up", "--no-viewer", "--rig", str(rig)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    took_s = time.monotonic() - begun
    assert done.returncode == 1
    assert "fusion needs at least two cameras" in done.stderr
    assert "fusion ended by itself" in done.stderr
    assert list(processes_that_name(str(rig))) == []
    in_time(took_s, 10.0, "nobody waits for a rig that cannot come up")


async def test_a_second_rig_on_the_same_keys_is_refused(router: BusConfig, tmp_path: Path) -> None:
    rig = make_rig(tmp_path / "rig", ("left", "right"))
    file = rig / "rig.toml"
    file.write_text(re.sub(r'"tcp/[^"]*"', f'"{router.connect[0]}"', file.read_text()))
    async with await Bus.open(router) as bus:
        bus.alive("rhot/alive/fusion/main")
        up = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "rhot", "up", "--no-viewer", "--rig", str(rig)), stderr=asyncio.subprocess.PIPE
        )
        _, said = await up.communicate()
    assert up.returncode == 1
    assert b"a rig runs at" in said
    assert b"already (fusion/main)" in said
    assert list(processes_that_name(str(rig))) == []


@pytest.mark.parametrize("variable", [True, False])
async def test_it_starts_the_rig_in_the_namespace_that_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: bool
) -> None:
    rig = make_rig(tmp_path / "rig", ("left", "right"))
    if variable:
        monkeypatch.setenv("RHOT_NAMESPACE", "desk1")
    words = [] if variable else ["--namespace", "desk1"]
    up = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rhot", "up", "--no-viewer", "--rig", str(rig), *words), stderr=asyncio.subprocess.PIPE
    )
    assert up.stderr is not None
    said = ""
    async for line in up.stderr:
        said += line.decode()
        if re.search("session .* runs", said):
            break
    else:
        pytest.fail(said)
    up.send_signal(signal.SIGINT)
    await up.communicate()


async def test_a_router_that_was_named_must_be_there(tmp_path: Path) -> None:
    rig = make_rig(tmp_path / "rig", ("left", "right"))
    elsewhere = free_endpoint("tcp/127.0.0.1:0")
    up = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rhot", "up", "--no-viewer", "--rig", str(rig), "--connect", elsewhere),
        stderr=asyncio.subprocess.PIPE,
    )
    _, said = await up.communicate()
    assert up.returncode == 1
    assert f"no Zenoh router answers at {elsewhere}" in said.decode()


def test_bridges_of_the_rig_run_and_end_with_it(tmp_path: Path, free_port: int) -> None:
    rig = make_rig(tmp_path / "rig", ("left", "right"))
    with (rig / "rig.toml").open("a") as toml:
        toml.write(f'\n[bridges.page]\ntarget = "json"\nport = {free_port}\n')
    command = [sys.executable, "-m", "rhot", "up", "--no-viewer", "--rig", str(rig)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if f"ws://127.0.0.1:{free_port}" in line:
                break
        else:
            pytest.fail("the bridge did not start")
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
        process.wait(timeout=10)
    assert "Traceback" not in rest
    assert list(processes_that_name(str(rig))) == []


def test_cameras_of_this_machine_are_started_where_no_other_reaches_the_router(tmp_path: Path) -> None:
    rig = load_rig(make_rig(tmp_path / "rig", ("left", "right")))
    cameras = {name: camera.model_copy(update={"source": "v4l2"}) for name, camera in rig.config.cameras.items()}
    usb = rig.config.model_copy(update={"cameras": cameras})
    assert cameras_here(usb, rig.config.bus) == ["left", "right"]
    for open_to_others in ({"listen": ("tcp/0.0.0.0:7447",)}, {"connect": ("tcp/192.168.1.10:7447",)}):
        assert cameras_here(usb, rig.config.bus.model_copy(update=open_to_others)) == []
    assert cameras_here(rig.config, rig.config.bus) == [], "this machine is no Pi"


@pytest.mark.parametrize("ended", [False, True])
def test_recorded_cameras_run_with_it_and_end_with_it(tmp_path: Path, ended: bool) -> None:
    rig = make_rig(tmp_path / "rig", ("left", "right"))
    writer = cv2.VideoWriter(str(rig / "view.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 480))
    for _ in range(30):
        writer.write(np.full((480, 640, 3), 90, np.uint8))
    writer.release()
    file = rig / "rig.toml"
    recorded = f'source = "video"\npath = "view.avi"\nloop = {str(not ended).lower()}'
    file.write_text(file.read_text().replace('source = "picamera2"', recorded))
    command = [sys.executable, "-m", "rhot", "up", "--no-viewer", "--rig", str(rig)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "the input has ended" in line or (not ended and "session" in line and line.endswith("runs\n")):
                break
        there = " ".join(processes_that_name(str(rig)))
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
        process.wait(timeout=10)
    assert process.returncode == 130
    assert "Traceback" not in rest
    assert "--camera=left" in there and "--camera=right" in there
    assert list(processes_that_name(str(rig))) == []


async def test_fusion_and_ik_share_a_process_where_that_is_asked_for(tmp_path: Path) -> None:
    rig = make_rig(tmp_path / "rig", ("left", "right"))
    command = [sys.executable, "-m", "rhot", "up", "--one-process", "--no-viewer", "--rig", str(rig)]
    up = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.PIPE)
    try:
        async with await Bus.open(BusConfig(connect=load_rig(rig).config.bus.connect), timeout_s=PATIENCE_S) as bus:
            for service in ("fusion/main", "ik/main"):
                await wait_for_status(bus, service, lambda status: status.state == "running")
            assert not [words for words in processes_that_name(str(rig)) if "rhot ik" in words]
            seen = bus.latest("rhot/points")
            frames = {name: bus.publisher(f"rhot/markers/{name}", MarkerFrame) for name in ("left", "right")}
            async with asyncio.timeout(PATIENCE_S):
                while "input" not in (await wait_for_status(bus, "ik/main", lambda _: True)).rates:
                    for camera, u in (("left", 330.0), ("right", 290.0)):
                        marker = Marker(u=u, v=240.0, area=60.0, score=0.9)
                        markers = {"thumb": marker}
                        frames[camera].put(
                            MarkerFrame(t_ns=time.time_ns(), camera=camera, width=640, height=480, markers=markers)
                        )
                # Who is elsewhere on the bus hears of the points, too.
                await anext(seen.messages(PointSet))
        up.send_signal(signal.SIGINT)
        _, said = await up.communicate()
    finally:
        if up.returncode is None:
            up.kill()
    assert up.returncode == 130
    assert b"Traceback" not in said
    assert list(processes_that_name(str(rig))) == []
