"""Frame sources: all kinds of cameras behind one Protocol."""

from rhot_capture.sources.factory import grab, open_source
from rhot_capture.sources.frame import Frame, ReportsProblem, Source

__all__ = ["Frame", "ReportsProblem", "Source", "grab", "open_source"]
