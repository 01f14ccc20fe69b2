"""Which blobs of one picture were taken for markers, which were not, and why.

The detector itself runs over the pictures before, so that it expects the markers where the live one did; then every
blob of a marker's colour in the picture is measured against what the detector asks of it, in its order.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.errors import ConfigError
from rhot.explain import Explanation, ExplanationRow, Outline, PictureExplanation, Verdict
from rhot.recording import PictureTrack, VideoTrack
from rhot.rig import MarkerConfig, Rig
from rhot.rig.colors import load_colors
from rhot_capture.detection import candidates as limits
from rhot_capture.detection.blob import Blob, find_blobs
from rhot_capture.detection.color_table import ImageArray, build_color_table
from rhot_capture.detection.detector import Detection, MarkerDetector
from rhot_capture.detection.track import MarkerTrack
from rhot_capture.preview import jpeg_of
from rhot_capture.sources.pictures import read_pictures

_SMALLEST_PX: Final = 4.0
_MOST_SHOWN: Final = 6
_BOX_3: Final = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class _Looks:
    """What is measured of a blob.

    Attributes:
        blob: it.
        fill: share of it that has the marker's own colour.
        thin: none of it is further than a pixel from its rim.
        continues: it is where the marker just was, nearly to the pixel.
        clings: it hangs on a larger blob of another marker.
        colour: how typical its colour is, 1 = as pure paint.
        expected_px: distance from where the track expects the marker; NaN without one.
    """

    blob: Blob
    fill: float
    thin: bool
    continues: bool
    clings: bool
    colour: float
    expected_px: float


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
        self._table = build_color_table(load_colors(rig.colors_path), list(self._markers))
        self._detector = MarkerDetector(self._markers, self._table, size.width, size.height)
        self._tracks = {name: MarkerTrack() for name in self._markers}

    def look(self, image: ImageArray) -> dict[str, Detection]:
        """Take a picture (H, W, 3), uint8 BGR, and return what is seen in it."""
        found = self._detector.detect(image)
        for name, track in self._tracks.items():
            detection = found.get(name)
            if detection is None:
                track.miss()
            else:
                track.hit(detection.u, detection.v, detection.area)
        return found

    def explain(self, image: ImageArray) -> PictureExplanation:
        """Take the next picture and explain what was seen in it.

        Raises:
            ConfigError: it is not of the camera's size.
        """
        before = copy.deepcopy(self._tracks)
        found = self.look(image)
        labels = self._detector.labels
        rows: list[ExplanationRow] = []
        outlines: list[Outline] = []
        for label, (name, marker) in enumerate(self._markers.items(), start=1):
            detection = found.get(name)
            blobs = find_blobs(labels, label, _SMALLEST_PX, math.inf)
            if not blobs:
                rows.append(ExplanationRow((name, *([""] * 8), "nothing of its colour in the picture"), "refused"))
            chosen = (
                None if detection is None else min(blobs, key=lambda blob: _distance_px(blob, detection), default=None)
            )
            for blob in blobs[:_MOST_SHOWN]:
                looks = self._looks(image, labels, label, blob, before[name])
                taken = blob is chosen
                why = "taken" if taken else _reason(looks, marker, detection is not None)
                rows.append(ExplanationRow((name, *_cells(looks, detection if taken else None), why), _verdict(taken)))
                text = name if taken else f"{name}: {why.partition(':')[0]}"
                outlines.append(
                    Outline(np.concatenate(blob.outlines).reshape(-1, 2).astype(np.float64), text, _verdict(taken))
                )
        columns = (
            *("marker", "u, v, px", "area, px²", "solidity", "own colour", "colour typical", "on border"),
            *("off track, px", "score", "verdict"),
        )
        note = (
            f"Blobs of each marker's colour, largest first. Asked for: the marker's own area, solidity of at least "
            f"{limits.MIN_SOLIDITY:g}, own colour on {100 * limits.MIN_FILL:.0f} % of it, a core that is not thin, "
            f"not hanging on a larger blob of another marker, altogether at least {limits.MIN_PLAUSIBILITY:g} alike. "
            "Found anew in the recorded picture; its coding can cost a live marker a pixel or two of its area."
        )
        return PictureExplanation(
            jpeg_of(image), Explanation("Candidates", columns, tuple(rows), note), tuple(outlines)
        )

    def _looks(self, image: ImageArray, labels: ImageArray, label: int, blob: Blob, track: MarkerTrack) -> _Looks:
        window = labels[blob.window]
        own = cv2.bitwise_and(cv2.inRange(window, label, label), blob.mask)
        _, packed = self._table.classify(np.ascontiguousarray(image[blob.window]))
        likelihood = cv2.mean(cv2.LUT(packed, self._table.likelihoods), own)[0] / 255.0
        expected = track.region(0.0, *labels.shape)
        away = math.nan if expected is None else math.dist(_middle(blob), expected[:2])
        return _Looks(
            blob=blob,
            fill=cv2.countNonZero(own) / max(blob.area, 1.0),
            thin=cv2.countNonZero(cv2.erode(own, _BOX_3)) == 0,
            continues=track.continues(*_middle(blob)),
            clings=limits.clings(blob, window, label),
            colour=min(1.0, likelihood / limits.TYPICAL_LIKELIHOOD),
            expected_px=away,
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


def _reason(looks: _Looks, marker: MarkerConfig, other_taken: bool) -> str:
    blob = looks.blob
    reasons = (
        (blob.area < marker.min_area_px, f"too small: {blob.area:.0f} px², min_area_px = {marker.min_area_px:g}"),
        (blob.area > marker.max_area_px, f"too large: {blob.area:.0f} px², max_area_px = {marker.max_area_px:g}"),
        (
            blob.solidity < limits.MIN_SOLIDITY,
            f"ragged: solidity {blob.solidity:.2f}, at least {limits.MIN_SOLIDITY:g}",
        ),
        (
            looks.fill < limits.MIN_FILL,
            f"hollow: own colour on {100 * looks.fill:.0f} %, at least {100 * limits.MIN_FILL:.0f} %",
        ),
        (looks.thin and not looks.continues, "thin: no core of pure colour, and not where the marker just was"),
        (looks.clings, "rim of another marker: it hangs on a larger blob of that colour"),
        (other_taken, "another blob: fits better by likeness, size and place"),
    )
    unlike = f"not like the marker: colour {looks.colour:.2f} of typical, {100 * blob.border_share:.0f} % on the border"
    return next((text for applies, text in reasons if applies), unlike)


def _cells(looks: _Looks, detection: Detection | None) -> tuple[str, ...]:
    blob = looks.blob
    u, v = _middle(blob)
    return (
        f"{u:.1f}, {v:.1f}" if detection is None else f"{detection.u:.2f}, {detection.v:.2f}",
        f"{blob.area:.0f}",
        f"{blob.solidity:.2f}",
        f"{100 * looks.fill:.0f} %",
        f"{looks.colour:.2f}",
        f"{100 * blob.border_share:.0f} %",
        "" if math.isnan(looks.expected_px) else f"{looks.expected_px:.1f}",
        "" if detection is None else f"{detection.score:.3f}",
    )


def _middle(blob: Blob) -> tuple[float, float]:
    height, width = blob.mask.shape
    return blob.x0 + 0.5 * (width - 1), blob.y0 + 0.5 * (height - 1)


def _distance_px(blob: Blob, detection: Detection) -> float:
    return math.dist(_middle(blob), (detection.u, detection.v))


def _verdict(taken: bool) -> Verdict:
    return "taken" if taken else "refused"
