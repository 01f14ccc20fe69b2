"""Which blobs of one picture were taken for markers, which were not, and why: what the detector itself decided.

The detector runs over the pictures before, so that it expects the markers where the live one did. While it follows all
markers it looks at small windows only; blobs beyond these are judged by its own search of the whole picture.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Final

from rhot.arrays import ImageArray
from rhot.errors import ConfigError
from rhot.explain import Explanation, ExplanationRow, Outline, PictureExplanation, Verdict
from rhot.recording import PictureTrack, VideoTrack
from rhot.recording.camera_picture import jpeg_of
from rhot.rig import MarkerConfig, Rig
from rhot.rig.colors import load_colors
from rhot.rig.marker_config import own_paints
from rhot_capture.detection.blob import Blob
from rhot_capture.detection.candidates import MIN_FILL, MIN_PLAUSIBILITY, MIN_SOLIDITY, Candidate, Reason, Refusal
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.cutouts import Region
from rhot_capture.detection.detector import Detection, MarkerDetector
from rhot_capture.sources.pictures import read_pictures

_MOST_SHOWN: Final = 6
"""Blobs of one marker's colour; the largest are shown."""
_COLUMNS: Final = (
    *("marker", "u, v, px", "area, px²", "solidity", "own colour", "colour typical", "on border"),
    *("off track, px", "score", "verdict"),
)
_NOTE: Final = (
    "Blobs of each marker's colour, largest first. Asked for: the marker's own area, solidity of at least "
    f"{MIN_SOLIDITY:g}, own colour on {100 * MIN_FILL:.0f} % of it, a core that is not thin, "
    f"not hanging on a larger blob of another marker, altogether at least {MIN_PLAUSIBILITY:g} alike. "
    "An empty cell was not looked at. "
    "Found again in the recorded picture; its coding can cost a live marker a pixel or two of its area."
)
_REASONS: Final[dict[Reason, str]] = {
    "too small": "too small: {area:.0f} px², min_area_px = {marker.min_area_px:g}",
    "too large": "too large: {area:.0f} px², max_area_px = {marker.max_area_px:g}",
    "ragged": f"ragged: solidity {{solidity:.2f}}, at least {MIN_SOLIDITY:g}",
    "hollow": f"hollow: own colour on {{fill:.0f}} %, at least {100 * MIN_FILL:.0f} %",
    "thin": "thin: no core of pure colour, and not where the marker just was",
    "rim": "rim of another marker: it hangs on a larger blob of that colour",
    "unlike": "not like the marker: hardly any of its colour is typical, or all of its rim is on the border",
    "outsized": "too large for its hand: {area:.0f} px², several times what the other markers of the hand let expect",
    "cut": "cut: it goes on beyond the region that was searched",
}


class PictureExplainer:
    """Explains pictures of one camera."""

    def __init__(self, rig: Rig, camera: str) -> None:
        """Prepare.

        Args:
            rig: with colours.
            camera: of the rig.

        Raises:
            CalibrationError: `colors.json` is missing or wrong.
        """
        self._markers = rig.config.markers
        size = rig.cameras[camera]
        table = build_color_table(load_colors(rig.colors_path), list(own_paints(self._markers)), camera)
        self._detector = MarkerDetector(self._markers, table, size.width, size.height)

    def look(self, image: ImageArray) -> dict[str, Detection]:
        """Take a picture (H, W, 3), uint8 BGR, and return what is seen in it."""
        return self._detector.detect(image)

    def explain(self, image: ImageArray) -> PictureExplanation:
        """Take the next picture and explain what was seen in it.

        Raises:
            ConfigError: it is not of the camera's size.
        """
        before = copy.deepcopy(self._detector)
        found = self.look(image)
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
                rows.append(ExplanationRow((name, *([""] * 8), "nothing of its colour in the picture"), "refused"))
            for each in sorted(judged, key=lambda each: each.blob.area, reverse=True)[:_MOST_SHOWN]:
                taken = detection if detection is not None and detection.blob is each.blob else None
                why = "taken" if taken is not None else _reason(each, marker, detection is not None)
                verdict: Verdict = "refused" if taken is None else "taken"
                cells = _cells(each, taken, before.expected(name))
                rows.append(ExplanationRow((name, *cells, why), verdict))
                text = name if taken else f"{name}: {why.partition(':')[0]}"
                outlines.append(Outline(each.blob.rim, text, verdict))
        return PictureExplanation(
            jpeg_of(image), Explanation("Candidates", _COLUMNS, tuple(rows), _NOTE), tuple(outlines)
        )


def explain_last(rig: Rig, track: PictureTrack | VideoTrack) -> PictureExplanation:
    """Return why markers were seen or not in the last picture of a track; the entry point of `rhot explain`.

    Args:
        rig: with colours.
        track: the pictures of one camera up to the moment, one at least; some dozens before it are enough.

    Raises:
        ConfigError: the rig does not know the camera, or a picture cannot be read or is of another size.
        CalibrationError: `colors.json` is missing or wrong.
    """
    if track.name not in rig.cameras:
        raise ConfigError(f"no camera {track.name} in {rig.path / 'rig.toml'}; it has {', '.join(rig.cameras)}")
    explainer = PictureExplainer(rig, track.name)
    last = len(track.t_ns) - 1
    for number, image in enumerate(read_pictures(track)):
        if number == last:
            return explainer.explain(image)
        explainer.look(image)
    raise ConfigError(f"camera {track.name}: there is no picture before this moment")


def _in(region: Region, blob: Blob) -> bool:
    u, v = blob.middle
    return region.left <= u < region.right and region.top <= v < region.bottom


def _reason(judged: Candidate | Refusal, marker: MarkerConfig, other_taken: bool) -> str:
    blob = judged.blob
    if isinstance(judged, Refusal):
        return _REASONS[judged.reason].format(
            area=blob.area, marker=marker, solidity=blob.solidity, fill=100 * judged.fill
        )
    if other_taken:
        return "another blob: fits better by likeness, size and position"
    return (
        f"not like the marker: colour {math.exp(judged.evidence.colour):.2f} of typical, "
        f"{100 * blob.border_share:.0f} % on the border"
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
