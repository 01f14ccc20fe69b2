"""Recordings and live hands as arrays, for programs and notebooks; `rhot.load`, `rhot.track` and `rhot.connect`."""

from rhot.take.take import Take
from rhot.take.tracks import HandTrack, JointTrack, MarkerTracks, PointTrack, RigidTrack, Track

__all__ = ["HandTrack", "JointTrack", "MarkerTracks", "PointTrack", "RigidTrack", "Take", "Track"]
