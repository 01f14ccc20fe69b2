"""Recordings on disk: pictures, video or two-dimensional marker tracks per camera, with times."""

from rhot.recording.folder import MarkerTrackFrames, load_camera, load_recording, marker_track_frames
from rhot.recording.model import CameraTrack, MarkerTrack, PictureTrack, Recording, TrackTiming, VideoTrack

__all__ = [
    "CameraTrack",
    "MarkerTrack",
    "MarkerTrackFrames",
    "PictureTrack",
    "Recording",
    "TrackTiming",
    "VideoTrack",
    "load_camera",
    "load_recording",
    "marker_track_frames",
]
