"""A take: everything that a recording holds, as arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.rotations import inverse
from rhot.take.tracks import HandTrack, JointTrack, MarkerTracks, PointTrack, RigidTrack, Track

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from rhot.messages import Event
    from rhot.rig import Rig


def _no_rig() -> None:
    return None


_MOST_SAMPLES: Final = 5_000_000
"""At a steady rate: a day at 60 Hz, more than an hour at 1 kHz."""


def require_few(count: int, span_s: float, rate_hz: float) -> None:
    """Refuse more samples at a steady rate than the memory holds, as where one has a time of another year.

    Raises:
        ConfigError: there would be.
    """
    if count > _MOST_SAMPLES:
        raise ConfigError(
            f"the poses lie {span_s / 3600:.1f} h apart, {count} frames at {rate_hz:.1f} Hz; {_MOST_SAMPLES} are the "
            "most. Was the clock set meanwhile, or does a stranger publish on the bus? `rhot export --csv` shows every "
            "time"
        )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Take:
    """What was tracked in one recording; lengths in metres, angles in radians, times on the rig clock.

    Attributes:
        hands: by side.
        points: markers in space, by name; all have the same times.
        objects: by name.
        feet: by side.
        body, head: None where there is none.
        events: marked moments, in order.
        frame: frame of all positions, `rig` unless `in_frame` chose another.
        spaces: T_rig_space (4, 4) of the frames that the recording knows, such as `stage`.
        start_ns: time 0 of the tracks' `t`: the first sample of anything.
        invalid: messages of the recording that are not valid and were left out.
        note: what is missing of a file that was cut off; empty for a whole one.
    """

    hands: Mapping[str, HandTrack]
    points: Mapping[str, PointTrack]
    objects: Mapping[str, RigidTrack]
    feet: Mapping[str, RigidTrack]
    body: JointTrack | None
    head: RigidTrack | None
    events: tuple[Event, ...]
    spaces: Mapping[str, FloatArray]
    start_ns: int
    frame: str = "rig"
    invalid: int = 0
    note: str = ""
    _markers: Callable[[], Mapping[str, MarkerTracks]] = dict
    _rig: Callable[[], Rig | None] = _no_rig

    def __repr__(self) -> str:
        head = f"<Take in frame {self.frame}, {len(self.events)} events{self.note and '; '}{self.note}>"
        return "\n  ".join([head, *map(repr, self.tracks.values())])

    @cached_property
    def markers(self) -> Mapping[str, MarkerTracks]:
        """What each camera saw, by camera; read from the file when it is first asked for."""
        return self._markers()

    @cached_property
    def rig(self) -> Rig | None:
        """The rig that the recording carries; None where it carries none."""
        return self._rig()

    @property
    def tracks(self) -> dict[str, Track]:
        """All tracks but the cameras': `hand/right`, `points/index`, `object/mug`, `foot/left`, `body`, `head`."""
        found: dict[str, Track] = {}
        for kind in (self.hands, self.points, self.objects, self.feet):
            found |= {track.name: track for track in kind.values()}
        found |= {track.name: track for track in (self.body, self.head) if track is not None}
        return found

    def _with(self, change: Callable[[Any], Any], **more: Any) -> Take:
        def each(tracks: Mapping[str, Any]) -> dict[str, Any]:
            return {name: change(track) for name, track in tracks.items()}

        return replace(
            self,
            hands=each(self.hands),
            points=each(self.points),
            objects=each(self.objects),
            feet=each(self.feet),
            body=None if self.body is None else change(self.body),
            head=None if self.head is None else change(self.head),
            **more,
        )

    def in_frame(self, name: str) -> Take:
        """Return the take in another frame: `rig`, or one of `spaces`, such as `stage` (y up, −z forward, floor at 0).

        Raises:
            ConfigError: the recording does not know that frame.
        """
        if name == self.frame:
            return self
        T_rig_now = self.spaces[self.frame] if self.frame != "rig" else np.eye(4)
        if name != "rig" and name not in self.spaces:
            known = ", ".join(("rig", *self.spaces))
            raise ConfigError(f"no frame {name!r}; the recording knows {known}. `rhot calibrate stage` finds the floor")
        T_rig_new = self.spaces[name] if name != "rig" else np.eye(4)
        T_new_now = inverse(T_rig_new) @ T_rig_now
        return self._with(lambda track: track.moved(T_new_now), frame=name)

    def resampled(self, rate_hz: float) -> Take:
        """Return the take at a steady rate from its start on, with common times; see `Track.resampled` for gaps.

        Raises:
            ValueError: the rate is not a positive number.
            ConfigError: there would be more than five million samples.
        """
        if not 0.0 < rate_hz < np.inf:
            raise ValueError(f"rate_hz must be a positive number, got {rate_hz}")
        last_ns = max((int(track.t_ns[-1]) for track in self.tracks.values() if len(track)), default=self.start_ns)
        span_s = 1e-9 * (last_ns - self.start_ns)
        count = int(span_s * rate_hz + 1e-6) + 1
        require_few(count, span_s, rate_hz)
        t_ns: NDArray[np.int64] = self.start_ns + np.round(1e9 / rate_hz * np.arange(count)).astype(np.int64)
        return self._with(lambda track: track.resampled(t_ns))

    def to_dataframe(self, name: str) -> pd.DataFrame:
        """Return a track as a pandas table: index `t` in seconds, columns as `rhot export --csv` names them.

        Args:
            name: of a track, such as `hand/right`; see `tracks`.

        Raises:
            KeyError: no such track.
            ModuleNotFoundError: pandas is not installed.
        """
        from rhot.take.tables import dataframe  # noqa: PLC0415  # loads pandas

        return dataframe(self._track(name))

    def to_xarray(self, what: str = "hands") -> xr.Dataset:
        """Return tracks as an xarray dataset in the layout of the package movement.

        Dimensions are time (seconds), space (x, y, z), keypoints and individuals; variables `position`, `sigma` and
        `confidence` (1 measured, 0.5 in one view, 0 predicted). Tracks of different times are joined, NaN where one has
        none.

        Args:
            what: `hands` (individuals are the sides), `points`, `objects`, `feet` or `body`.

        Raises:
            KeyError: the take holds none of these.
            ModuleNotFoundError: xarray is not installed.
        """
        from rhot.take.tables import dataset  # noqa: PLC0415  # loads xarray

        return dataset(self, what)

    def _track(self, name: str) -> Track:
        tracks = self.tracks
        if name not in tracks:
            raise KeyError(f"no track {name!r}; there are {', '.join(tracks) or 'none'}")
        return tracks[name]
