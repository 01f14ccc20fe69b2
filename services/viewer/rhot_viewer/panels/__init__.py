"""The tabs of the page's panel, one class each."""

from rhot_viewer.panels.base import Panel
from rhot_viewer.panels.cameras import CamerasPanel
from rhot_viewer.panels.live import LivePanel
from rhot_viewer.panels.pictures import PicturesPanel
from rhot_viewer.panels.timeline import TimelinePanel
from rhot_viewer.panels.view import ViewPanel

__all__ = ["CamerasPanel", "LivePanel", "Panel", "PicturesPanel", "TimelinePanel", "ViewPanel"]
