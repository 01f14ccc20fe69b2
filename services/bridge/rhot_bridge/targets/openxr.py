"""OpenXR: both hands in shared memory, for the API layer that gives them to every OpenXR program on this machine.

`openxr/rhot_hands.h` is the layout and the sequence lock. Every sample of a hand is written once, in the stage frame,
with the monotonic time at which the hand was there and with velocities, from which the layer predicts.
"""

from __future__ import annotations

import math
import mmap
import os
import sys
import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from time import monotonic_ns
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.clock import RigClock
from rhot.errors import DeviceError
from rhot.geometry.rotations import inverse, rigid, rotation_from_quaternion, rotation_vectors, rotation_y
from rhot.messages import Event
from rhot.rig import BridgeConfig
from rhot_bridge.axes import Converter
from rhot_bridge.clock_map import ClockMap
from rhot_bridge.scene import Axes, BridgedHand, Scene, Tracked

if sys.platform != "win32":
    import fcntl

# The memory.

MAGIC: Final = 0x444E4148
VERSION: Final = 1
SIDES: Final = ("left", "right")
ABSENT, PREDICTED, MEASURED = 0, 1, 2
JOINT: Final = np.dtype(
    [
        ("position", "<f4", 3),
        ("orientation", "<f4", 4),
        ("radius", "<f4"),
        ("linear_velocity", "<f4", 3),
        ("angular_velocity", "<f4", 3),
    ]
)
HAND: Final = np.dtype([("sequence", "<u4"), ("state", "<u4"), ("t_ns", "<i8"), ("joints", JOINT, len(JOINTS))])
HANDS: Final = np.dtype([("magic", "<u4"), ("version", "<u4"), ("hands", HAND, len(SIDES))])
"""The structures of `rhot_hands.h`."""
WINDOWS_NAME: Final = "Local\\rhot_hands"


def memory_path() -> Path:
    """Return the file of the shared memory; not on Windows, where it is a named mapping."""
    if sys.platform == "win32":
        user = ""
    else:
        user = f".{os.getuid()}"
    # POSIX shared memory, as the layer looks for it.
    return Path(os.environ.get("RHOT_HANDS") or f"/dev/shm/rhot_hands{user}")


def mapped_bytes() -> bytes:
    """Return what is in the memory now; empty where no bridge has been.

    Raises:
        OSError: it cannot be read.
    """
    if sys.platform == "win32":
        with mmap.mmap(-1, HANDS.itemsize, tagname=WINDOWS_NAME, access=mmap.ACCESS_READ) as mapping:
            return mapping[:]
    else:  # for mypy, which reads what follows a platform's return as dead
        return memory_path().read_bytes()


class HandsMemory:
    """The shared memory as its one writer sees it; created where it is not there, and left when the writer ends."""

    def __init__(self) -> None:
        """Map the memory; both hands are absent.

        Raises:
            DeviceError: another bridge writes it, or it cannot be created.
        """
        self._file = -1
        self._mapping = self._mapped()
        self._hands = np.frombuffer(self._mapping, HANDS, 1)
        # Neither Python nor the processor may move a hand's words past its sequence: taking a lock is a barrier.
        self._barrier = threading.Lock()
        for side in range(len(SIDES)):
            self._write(side, ABSENT, 0, None)
        self._hands["magic"], self._hands["version"] = MAGIC, VERSION

    def _mapped(self) -> mmap.mmap:
        if sys.platform == "win32":
            return mmap.mmap(-1, HANDS.itemsize, tagname=WINDOWS_NAME)
        else:  # noqa: RET505  # for mypy, which reads what follows a platform's return as dead
            path = memory_path()
            try:
                self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(self._file).st_size < HANDS.itemsize:
                    os.ftruncate(self._file, HANDS.itemsize)
                return mmap.mmap(self._file, HANDS.itemsize)
            except BlockingIOError as error:
                raise DeviceError(f"{path}: another `rhot bridge openxr` writes there; end it first") from error
            except (OSError, ValueError) as error:
                raise DeviceError(f"{path}: the hands' shared memory cannot be made: {error}") from error

    def write(self, side: str, state: int, t_ns: int, joints: NDArray[np.void]) -> None:
        """Write a hand: its joints (26,) of type `JOINT`, as they were at `t_ns` on the monotonic clock."""
        self._write(SIDES.index(side), state, t_ns, joints)

    def _write(self, side: int, state: int, t_ns: int, joints: NDArray[np.void] | None) -> None:
        hand = self._hands["hands"][0, side : side + 1]
        # Odd after a writer that died while it wrote, too.
        odd = (int(hand["sequence"][0]) | 1) & 0xFFFFFFFF
        hand["sequence"] = odd
        with self._barrier:
            hand["state"], hand["t_ns"] = state, t_ns
            if joints is not None:
                hand["joints"] = joints
        hand["sequence"] = (odd + 1) & 0xFFFFFFFF

    def close(self) -> None:
        """Take both hands away; the memory stays, for programs that have mapped it."""
        for side in range(len(SIDES)):
            self._write(side, ABSENT, 0, None)
        del self._hands
        self._mapping.close()
        if self._file >= 0:
            os.close(self._file)


# Velocities.

WINDOW_NS: Final = 60_000_000
"""Samples of this long make a velocity. 30 ms ahead, the simulated hand is then off by 0.74 mm (p95 4.2) in motion,
1.53 (6.4) without a velocity; at rest by 0.50 and 0.35. 40 ms gives 0.85 (4.1) and 0.58, 100 ms 0.70 (4.9), 0.43.
Where samples are rarer, as from cameras at 15 Hz that expose together, two make one, at most twice as far apart."""

LEAST_NS: Final = 30_000_000
"""A shorter window counts as this long: a point that has just been found again is noisy. Recorded hands, 30 ms ahead,
fingers within 60 ms of their return, 99 %: 46 mm at 60 and 45 at 30 fps; without this 62 and 61; without a window that
begins at the return 50 and 121."""


class Motion:
    """Velocities of a hand's joints from its newest samples: the change between the first and the last of a window.

    What a finger does when a camera sees it again is no motion: its window begins there.
    """

    def __init__(self) -> None:
        self._samples: deque[BridgedHand] = deque()
        self._since_ns = np.zeros(len(JOINTS), dtype=np.int64)

    def add(self, hand: BridgedHand) -> tuple[FloatArray, FloatArray]:
        """Take a sample; return linear (26, 3), m/s, and angular velocity (26, 3), rad/s, about the frame's axes.

        Both are zero where nothing is known of before.
        """
        samples = self._samples
        if samples and hand.t_ns <= samples[-1].t_ns:
            samples.clear()
            self._since_ns[:] = 0
        if samples:
            self._since_ns[hand.measured & ~samples[-1].measured] = hand.t_ns
        samples.append(hand)
        while hand.t_ns - samples[0].t_ns > (WINDOW_NS if len(samples) > 2 else 2 * WINDOW_NS):
            samples.popleft()
        times_ns, joints = np.array([sample.t_ns for sample in samples]), np.arange(len(JOINTS))
        first = np.searchsorted(times_ns, self._since_ns)
        positions = np.array([sample.positions for sample in samples])[first, joints]
        orientations = np.array([sample.orientations for sample in samples])[first, joints]
        seconds = np.maximum(hand.t_ns - times_ns[first], LEAST_NS)[:, None] / 1e9
        before, now = rotation_from_quaternion(orientations), rotation_from_quaternion(hand.orientations)
        turns = rotation_vectors(now @ before.swapaxes(1, 2))
        return (hand.positions - positions) / seconds, turns / seconds


# The bridge's output.


class OpenXrOutput:
    """The shared memory as a bridge's output; see `rhot_bridge.output.SampleOutput`."""

    triggers: Sequence[str] = ()
    problem = ""
    axes: Axes = "stage"

    def __init__(self, config: BridgeConfig) -> None:
        """Prepare; uses `offset` and `predicted` of the configuration."""
        self._memory: HandsMemory | None = None
        self._clock: RigClock | None = None
        self._map = ClockMap()
        self._motions = {side: Motion() for side in SIDES}
        self._written_ns: dict[str, int] = {}
        self.use_config(config)

    @property
    def where(self) -> str:
        """Where the memory is, for people."""
        return f"OpenXR's hands in {WINDOWS_NAME if sys.platform == 'win32' else memory_path()}"

    def use_clock(self, clock: RigClock) -> None:
        """Set the rig clock that samples are timed on."""
        self._clock = clock

    def use_config(self, config: BridgeConfig) -> None:
        """Follow changed settings."""
        self._predicted = config.predicted == "send"
        *shift, turn_deg = config.offset
        self._offset = Converter("stage", inverse(rigid(rotation_y(math.radians(turn_deg)), np.array(shift))))

    async def open(self) -> None:
        """Map the memory.

        Raises:
            DeviceError: see `HandsMemory`.
        """
        self._memory = HandsMemory()

    def wanted(self, now_ns: int) -> bool:
        """Return False: hands are written one by one, not as scenes."""
        return False

    def send(self, scene: Scene, now_ns: int) -> tuple[int, int]:
        """Send nothing."""
        return 0, 0

    def send_event(self, event: Event) -> bool:
        """Send nothing: OpenXR programs know no marked moments."""
        return False

    def send_sample(self, key: str, tracked: Tracked) -> bool:
        """Write a hand in the stage frame; return whether it was written."""
        if self._memory is None or not isinstance(tracked, BridgedHand):
            return False
        side = key.rpartition("/")[2]
        if side not in self._motions or tracked.t_ns == self._written_ns.get(side):
            return False
        if not self._map.follow(self._clock, monotonic_ns):
            return False
        self._written_ns[side] = tracked.t_ns
        hand = self._offset.poses(tracked)
        linear, angular = self._motions[side].add(hand)
        state = MEASURED if hand.state == "measured" else PREDICTED if self._predicted else ABSENT
        joints = np.zeros(len(JOINTS), JOINT)
        joints["position"], joints["orientation"], joints["radius"] = hand.positions, hand.orientations, hand.radii
        joints["linear_velocity"], joints["angular_velocity"] = linear, angular
        self._memory.write(side, state, self._map.to_local_ns(hand.t_ns), joints)
        return True

    async def close(self) -> None:
        """Take the hands away."""
        if self._memory is not None:
            self._memory.close()
            self._memory = None
        self._written_ns.clear()


def make_output(config: BridgeConfig) -> OpenXrOutput:
    """Return the output that a configuration asks for."""
    return OpenXrOutput(config)
