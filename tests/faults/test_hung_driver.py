"""A real capture process whose camera falls silent and whose driver hangs: it ends, is restarted and delivers."""

from __future__ import annotations

import asyncio
import os
import textwrap
import time
from pathlib import Path

import pytest
from bus_watch import wait_for_status

from rhot.bus import Bus
from rhot.errors import EXIT_AGAIN
from rhot.messages import Control
from rhot.operation.supervisor import Supervisor
from rhot.rig import BusConfig
from rhot.rig.template import rig_template
from rhot.service.clock_sync import serve_clock

pytestmark = pytest.mark.faults

LIMIT_S = 60.0
SUPPORT = Path(__file__).parents[1] / "support"

PICAMERA2 = f"""
    import sys, threading, time
    from pathlib import Path

    sys.path.append({str(SUPPORT)!r})
    from devices.fake_picamera2 import FakePicamera2, MappedArray

    SILENT = Path(__file__).with_name("silent")


    class Picamera2(FakePicamera2):
        def __init__(self, number):
            super().__init__(number)
            threading.Thread(target=self._expose, daemon=True).start()

        @staticmethod
        def global_camera_info():
            return [{{"Model": "imx219"}}]

        def _expose(self):
            while True:
                time.sleep(0.02)
                # The kernel waits for buffers that never come: raspberrypi/picamera2 issue 1275.
                self.stop_hangs = SILENT.exists()
                if not self.stop_hangs:
                    self.complete(time.clock_gettime_ns(time.CLOCK_BOOTTIME))
"""
LIBCAMERA = f"""
    import sys

    sys.path.append({str(SUPPORT)!r})
    from devices.fake_picamera2 import CONTROLS as controls
"""


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that stands in for what apt installs on a Pi; while it holds `silent`, the camera is."""
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "picamera2.py").write_text(textwrap.dedent(PICAMERA2))
    (folder / "libcamera.py").write_text(textwrap.dedent(LIBCAMERA))
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    return folder


async def test_a_capture_service_whose_driver_hangs_is_back_after_a_new_start(
    tmp_path: Path, endpoint: str, router: BusConfig, modules: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rig = tmp_path / "rig"
    rig.mkdir()
    (rig / "rig.toml").write_text(rig_template(folder="rig", name="hung", connect=(endpoint,)))
    supervisor = Supervisor(tmp_path)
    keeping: asyncio.Task[object] | None = None
    try:
        async with await Bus.open(router) as bus:
            serve_clock(bus)
            child = await supervisor.start("capture left", ["capture", "--camera", "left", "--rig", str(rig)])
            keeping = asyncio.create_task(supervisor.keep_running())
            control = bus.publisher("rhot/control", Control, reliable=True)
            assert await control.wait_for_reader(LIMIT_S)
            now_ns = time.time_ns()
            start = Control(t_ns=now_ns, action="start", session="s", start_t_ns=now_ns)
            control.put(start)
            await wait_for_status(bus, "capture/left", lambda status: status.counts.get("frames", 0) > 10)
            (modules / "silent").touch()
            assert await asyncio.wait_for(child.process.wait(), LIMIT_S) == EXIT_AGAIN
            assert "camera left: close: its driver has not returned for 3 s" in child.tail()
            (modules / "silent").unlink()
            # Nobody else is there to tell the new process of the session.
            await wait_for_status(
                bus, "capture/left", lambda status: status.state == "waiting" and status.uptime_s < 30
            )
            control.put(start.model_copy(update={"t_ns": time.time_ns()}))
            await wait_for_status(bus, "capture/left", lambda status: status.counts.get("frames", 0) > 10)
            assert supervisor.children[0].process.pid != child.process.pid
            assert "capture left ended by itself with exit code 75" in caplog.text
    finally:
        if keeping is not None:
            keeping.cancel()
        await supervisor.stop()
