"""Explain which blobs of a picture were accepted as markers, and why the others were rejected.

The detector first processes the preceding pictures, so that its predictions are those of the live one. While it tracks
all markers it searches small windows only; for blobs outside them, the table shows its search of the whole picture.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Final

from rhot.anatomy.markers import own_paints
from rhot.arrays import ImageArray
from rhot.core import Explanation, ExplanationRow, Outline, PictureExplanation, Verdict
from rhot.errors import ConfigError
from rhot.geometry.hull import Region
from rhot.recording import PictureTrack, VideoTrack
from rhot.recording.camera_picture import jpeg_of
from rhot.rig import MarkerConfig, Rig
from rhot.rig.colors import load_colors
from rhot_capture.detection.blob import Blob
from rhot_capture.detection.candidates import MIN_FILL, MIN_PLAUSIBILITY, MIN_SOLIDITY, Candidate, Reason, Refusal
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.detection.result import Detection
from rhot_capture.sources.recorded import read_pictures

_COLUMNS: Final = (
    *("marker", "u, v, px", "area, px²", "solidity", "pixels of its colour", "colour likelihood", "at image border"),
    *("from prediction, px", "score", "verdict"),
)
_NOTE: Final = (
    "Blobs of each marker's colour, largest first. A marker needs an area within its limits, a solidity of at least "
    f"{MIN_SOLIDITY:g}, its own colour on at least {100 * MIN_FILL:.0f} % of its pixels, a core of pure colour, no "
    f"contact with a larger blob of another marker, and a plausibility of at least {MIN_PLAUSIBILITY:g}. Empty "
    "cells were not computed. Areas can differ from the live ones by a pixel or two because recorded pictures are "
    "compressed."
)
_REASONS: Final[dict[Reason, str]] = {
    "too small": "too small: {area:.0f} px², min_area_px = {marker.min_area_px:g}",
    "too large": "too large: {area:.0f} px², max_area_px = {marker.max_area_px:g}",
    "irregular": f"irregular shape: solidity {{solidity:.2f}}, minimum {MIN_SOLIDITY:g}",
    "mixed colours": f"mixed colours: own colour on {{fill:.0f}} %, minimum {100 * MIN_FILL:.0f} %",
    "thin": "thin: no core of pure colour, and not at the marker's last position",
    "edge": "edge of another marker: connected to a larger blob of that marker's colour",
    "unlikely": "unlikely: hardly any pixels of the typical colour, or the whole outline at the image border",
    "too large for hand": "too large for hand: {area:.0f} px², several times the size implied by the other markers",
    "apart from skin": "apart from skin: other fingertips adjoin skin, and this is not at the marker's last position",
    "behind the wrist": "behind the wrist: no fingertip is that far behind the patch",
    "clipped": "clipped: extends beyond the searched region",
}


class PictureExplainer:
    """Explains the detection in pictures of one camera."""

    def __init__(self, rig: Rig, camera: str) -> None:
        """Build the camera's detector.

        Args:
            rig: with `colors.json`.
            camera: its name.

        Raises:
            CalibrationError: `colors.json` is missing or wrong.
        """
        self._markers = rig.config.markers
        size = rig.cameras[camera]
        table = build_color_table(load_colors(rig.colors_path), list(own_paints(self._markers)), camera)
        self._detector = MarkerDetector(self._markers, table, size.width, size.height)

    def detect(self, image: ImageArray) -> dict[str, Detection]:
        """Detect the markers in the next picture (H, W, 3), uint8 BGR."""
        return self._detector.detect(image)

    def explain(self, image: ImageArray) -> PictureExplanation:
        """Detect the markers in the next picture and explain the result.

        Raises:
            ConfigError: its size is not that of the camera.
        """
        before = copy.deepcopy(self._detector)
        found = self.detect(image)
        decisions = self._detector.decisions
        elsewhere = [
            (name, each)
            for name, each in before.decide_everywhere(image).judged
            if not any(_in(region, each.blob) for _, region in decisions.looks)
        ]
        rows: list[ExplanationRow] = []
        outlines: list[Outline] = []
        for name, marker in self._markers.items():
            detection = found.get(name)
            judged = [each for whose, each in (*decisions.judged, *elsewhere) if whose in (name, marker.paint_of)]
            if not judged:
                rows.append(ExplanationRow((name, *([""] * 8), "no blob of its colour in the picture"), "rejected"))
            # Largest number of blobs shown per marker; the largest blobs are shown.
            for each in sorted(judged, key=lambda each: each.blob.area, reverse=True)[:6]:
                accepted = detection if detection is not None and detection.blob is each.blob else None
                verdict: Verdict = "rejected" if accepted is None else "accepted"
                why = verdict if accepted is not None else _reason(each, marker, detection is not None)
                cells = _cells(each, accepted, before.expected(name))
                rows.append(ExplanationRow((name, *cells, why), verdict))
                text = name if accepted else f"{name}: {why.partition(':')[0]}"
                outlines.append(Outline(each.blob.rim, text, verdict))
        return PictureExplanation(
            jpeg_of(image), Explanation("Candidates", _COLUMNS, tuple(rows), _NOTE), tuple(outlines)
        )


def explain_last(rig: Rig, track: PictureTrack | VideoTrack) -> PictureExplanation:
    """Explain the detection in the last picture of a track; the entry point of `rhot explain`.

    Args:
        rig: with `colors.json`.
        track: pictures of one camera, at least one; some dozens before the last one are sufficient.

    Raises:
        ConfigError: the camera is not in the rig, or a picture cannot be read or has another size.
        CalibrationError: `colors.json` is missing or wrong.
    """
    if track.name not in rig.cameras:
        raise ConfigError(f"no camera {track.name} in {rig.path / 'rig.toml'}; it has {', '.join(rig.cameras)}")
    explainer = PictureExplainer(rig, track.name)
    last = len(track.t_ns) - 1
    for number, image in enumerate(read_pictures(track)):
        if number == last:
            return explainer.explain(image)
        explainer.detect(image)
    raise ConfigError(f"camera {track.name}: no picture before this time")


def _in(region: Region, blob: Blob) -> bool:
    u, v = blob.middle
    return region.left <= u < region.right and region.top <= v < region.bottom


def _reason(judged: Candidate | Refusal, marker: MarkerConfig, other_accepted: bool) -> str:
    blob = judged.blob
    if isinstance(judged, Refusal):
        return _REASONS[judged.reason].format(
            area=blob.area, marker=marker, solidity=blob.solidity, fill=100 * judged.fill
        )
    if other_accepted:
        return "another blob: its colour, size and position fit better"
    return (
        f"unlikely: colour likelihood {math.exp(judged.evidence.colour):.2f}, "
        f"{100 * blob.border_share:.0f} % of the outline at the image border"
    )


def _cells(
    judged: Candidate | Refusal, detection: Detection | None, expected: Sequence[float] | None
) -> tuple[str, ...]:
    blob = judged.blob
    u, v = blob.middle
    return (
        f"{u:.1f}, {v:.1f}" if detection is None else f"{detection.u:.2f}, {detection.v:.2f}",
        f"{blob.area:.0f}",
        f"{blob.solidity:.2f}",
        "" if math.isnan(judged.fill) else f"{100 * judged.fill:.0f} %",
        f"{math.exp(judged.evidence.colour):.2f}" if isinstance(judged, Candidate) else "",
        f"{100 * blob.border_share:.0f} %",
        "" if expected is None else f"{math.dist(blob.middle, expected):.1f}",
        "" if detection is None else f"{detection.score:.3f}",
    )
