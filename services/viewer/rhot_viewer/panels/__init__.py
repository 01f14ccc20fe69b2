"""The tabs of the page's panel, one class each."""

from rhot_viewer.panels.calibrate import CalibratePanel
from rhot_viewer.panels.cameras import CamerasPanel
from rhot_viewer.panels.live import LivePanel
from rhot_viewer.panels.pictures import PicturesPanel
from rhot_viewer.panels.session import Panel, RecordPanel, TimelinePanel, ViewPanel

__all__ = [
    "CalibratePanel",
    "CamerasPanel",
    "LivePanel",
    "Panel",
    "PicturesPanel",
    "RecordPanel",
    "TimelinePanel",
    "ViewPanel",
]
