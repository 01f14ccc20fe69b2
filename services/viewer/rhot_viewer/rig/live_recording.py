"""Recording the running rig from the page with the functions of `rhot record`, and running `rhot explain`."""

from __future__ import annotations

import asyncio
import sys
import time
from pathlib import Path
from typing import Final

from rhot.atomic_file import why
from rhot.bus import CONNECT_S, Bus
from rhot.errors import ConfigError, RhotError
from rhot.recording.mcap.gaps import Tally
from rhot.rig import BusConfig
from rhot.text import printable

_LONGEST_NAME: Final = 100


class LiveRecording:
    """Records sessions to files.

    Attributes:
        folder: folder of all recordings.
        file: current or last file; None before the first.
        megabytes: size of the file.
        tally: counts of its messages.
        problem: why the last recording could not start or ended early; empty otherwise.
    """

    def __init__(self, bus: BusConfig, rig_path: Path, folder: Path) -> None:
        """Prepare; nothing is recorded yet.

        Args:
            bus: connection to the running rig.
            rig_path: rig folder, whose files are attached.
            folder: folder of all recordings.
        """
        self.file: Path | None = None
        self.megabytes = 0.0
        self.tally = Tally()
        self.problem = ""
        self._bus = bus
        self._rig_path = rig_path
        self.folder = folder
        self._asked: asyncio.Queue[Path] = asyncio.Queue()
        self._stop = asyncio.Event()
        self._begun: float | None = None
        self._lasted_s = 0.0

    @property
    def running(self) -> bool:
        """Whether it records now."""
        return self._begun is not None

    @property
    def seconds(self) -> float:
        """Duration of the recording in `file`."""
        return self._lasted_s if self._begun is None else time.monotonic() - self._begun

    @property
    def rate_hz(self) -> float:
        """Messages a second, over the whole file."""
        min_elapsed_s = 1e-3
        return self.tally.messages / max(self.seconds, min_elapsed_s)

    def start(self, below: str = "") -> None:
        """Start a file named after date and time, in a subfolder of the folder of recordings."""
        if self.running or not self._asked.empty():
            return
        try:
            folder = folder_below(self.folder, below)
        except ConfigError as error:
            self.problem = str(error)
        else:
            self._asked.put_nowait(folder / f"rhot-{time.strftime('%Y%m%d-%H%M%S')}.mcap")

    def stop(self) -> None:
        """End the file."""
        self._stop.set()

    async def run(self) -> None:
        """Record what is asked for, until cancelled."""
        while True:
            file = await self._asked.get()
            self.problem = ""
            self._stop.clear()
            try:
                await self._record(file)
            except ModuleNotFoundError as error:
                self.problem = f"recording needs the Python module {error.name}: pip install 'rhot[record]'"
            except RhotError as error:
                self.problem = str(error)
            except OSError as error:
                self.problem = f"{file}: the recording is lost or incomplete: {why(error)}"
            finally:
                if self._begun is not None:
                    self._lasted_s = time.monotonic() - self._begun
                self._begun = None

    async def _record(self, file: Path) -> None:
        # Only where somebody records: `mcap` is an extra.
        from rhot.recording.mcap.session import record, subscribe  # noqa: PLC0415
        from rhot.recording.mcap.writer import McapWriter, rig_files  # noqa: PLC0415

        async with await Bus.open(self._bus, timeout_s=CONNECT_S) as bus:
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigError(f"{file.parent}: cannot be made: {why(error)}") from error
            about = {"connect": ",".join(self._bus.connect), "namespace": self._bus.namespace}
            with McapWriter(
                file,
                now_ns=time.time_ns(),
                attachments=rig_files(self._rig_path),
                about={**about, "rig": str(self._rig_path.resolve())},
            ) as writer:
                self.file, self.tally, self.megabytes = file, Tally(), 0.0
                self._begun = time.monotonic()

                def note_size() -> None:
                    self.megabytes = writer.written_bytes / 1e6

                mailbox = subscribe(bus)
                await record(mailbox, writer, self.tally, self._stop, on_beat=note_size)
            self.megabytes = sum(each.stat().st_size for each in writer.files) / 1e6
        if mailbox.overwritten:
            self.problem = f"{mailbox.overwritten} samples were lost because the disk was too slow"
        elif self.tally.left_out:
            self.problem = f"{self.tally.left_out} samples on more keys than a rig has are left out"


def folder_below(folder: Path, name: str) -> Path:
    """Return a subfolder by the name that a user has typed.

    Raises:
        ConfigError: the name is not valid, or leads out of the folder.
    """
    below = Path(name.strip())
    plain = name.isprintable() and len(name) <= _LONGEST_NAME
    if not plain or below.is_absolute() or any(part.startswith(".") for part in below.parts):
        raise ConfigError(
            f"{printable(name, _LONGEST_NAME)}: recordings are kept below {folder}; name a folder in there, such as "
            "desk"
        )
    wanted = folder / below
    if not wanted.resolve().is_relative_to(folder.resolve()):
        raise ConfigError(f"{wanted}: leads out of {folder} through a link; name another folder")
    return wanted


async def explain(recording: Path, at: str, rig_path: Path) -> Path:
    """Run `rhot explain` on a recording and return the page that it has written beside it.

    Args:
        recording: MCAP file.
        at: seconds after its first marker frame.
        rig_path: the rig folder.

    Raises:
        ConfigError: the command failed; has its error message.
    """
    try:
        float(at)
    except ValueError as error:
        raise ConfigError(f"{printable(at, _LONGEST_NAME)}: not a number of seconds, such as 12.5") from error
    page = recording.with_suffix(".html")
    words = ["explain", str(recording), "--at", at, "--out", str(page), "--rig", str(rig_path)]
    # In a separate process, because it tracks ten seconds again while the page must respond.
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rhot", "-q", *words),
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        _, said = await process.communicate()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode != 0:
        raise ConfigError(said.decode(errors="replace").strip().removeprefix("rhot: error: ") or "rhot explain failed")
    return page
