"""All markers of a frame in one pass.

While every marker is where it was expected, only these windows are searched. As soon as one is not there, and every
`_SURVEY_FRAMES` frames anyway, the whole frame is searched, so a lost marker is found again wherever it turns up; where
a marker was before only decides between several blobs of its colour. What is missing even then is looked for once more
by fainter colours, near the other markers of its hand (`reach`). Either way all windows are classified together and
measured alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from rhot.arrays import FloatArray, ImageArray
from rhot.errors import ConfigError
from rhot.rig.config import MarkerConfig
from rhot.rig.marker_config import own_paints, worn_paints
from rhot_capture.detection.blob import Blob, Outsized, blobs_of
from rhot_capture.detection.candidates import MIN_PLAUSIBILITY, Candidate, Reason, Refusal, judge, likeliest
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.corners import find_corners
from rhot_capture.detection.cutouts import Cutouts, Region
from rhot_capture.detection.hand_scale import HandScale
from rhot_capture.detection.reach import HandReach
from rhot_capture.detection.score import probability
from rhot_capture.detection.search import find_regions
from rhot_capture.detection.sharing import SharedPaints, spot_of
from rhot_capture.detection.subpixel.centers import find_centres
from rhot_capture.detection.subpixel.windows import Window
from rhot_capture.detection.track import MarkerTrack

_SURVEY_FRAMES: Final = 30
"""So often the whole frame is searched although nothing is missing: half a second at 60 Hz. Chosen."""


class Detection(NamedTuple):
    """One marker in one frame; a tuple, as those of each frame are made in a quarter of the time of dataclasses.

    Attributes:
        u, v: sub-pixel centre of the visible painted area, pixels, pixel centres on integers.
        area: visible painted area, square pixels.
        score: the probability that this is the marker and its centre within a pixel of the truth; see
            `rhot_capture.detection.score`.
        corners: (4, 2) of a patch, pixels, clockwise as seen; None when they could not be found.
        blob: the painted area.
    """

    u: float
    v: float
    area: float
    score: float
    corners: FloatArray | None
    blob: Blob

    @property
    def outline(self) -> FloatArray:
        """(n, 2) pixels on the rim of the painted area."""
        return self.blob.rim


class Decisions(NamedTuple):
    """What was decided about the blobs of one frame.

    Attributes:
        looks: label and region of every part of the frame that was looked at.
        judged: name of the marker and candidate or refusal of every blob of a marker's colour in these.
        chosen: the candidates that were taken, with the evidence of all blobs.
    """

    looks: Sequence[tuple[int, Region]]
    judged: Sequence[tuple[str, Candidate | Refusal]]
    chosen: Mapping[str, Candidate]


class MarkerDetector:
    """Finds all markers of one camera, frame after frame."""

    def __init__(self, markers: Mapping[str, MarkerConfig], table: ColorTable, width: int, height: int) -> None:
        """Prepare for frames of one size.

        Args:
            markers: by name.
            table: built for the paints of these markers, in this order.
            width: of the frames, pixels.
            height: of the frames, pixels.

        Raises:
            ConfigError: the table was built for other markers.
        """
        self._markers = dict(markers)
        self._names = tuple(own_paints(markers))
        self._labels = {name: self._names.index(paint) + 1 for name, paint in worn_paints(markers).items()}
        self._gates = [(markers[name].min_area_px, markers[name].max_area_px) for name in self._names]
        self._sharing = SharedPaints(markers)
        self._reach = HandReach(markers)
        self._scale = HandScale(markers)
        self._size = (height, width)
        self._tracks = {name: MarkerTrack() for name in markers}
        # Corners of patches in the last frame, from their centres.
        self._shapes: dict[str, list[tuple[float, float]]] = {}
        self._image: ImageArray = np.zeros((height, width, 3), np.uint8)
        self._since_survey = 0
        self._looks: list[tuple[int, Region]] = []
        self._judged: list[tuple[str, Candidate | Refusal]] = []
        self._outsized: list[Outsized] = []
        self._chosen: Mapping[str, Candidate] = {}
        self.table = table

    @property
    def table(self) -> ColorTable:
        """The colours in use; may be replaced between frames."""
        return self._table

    @table.setter
    def table(self, table: ColorTable) -> None:
        if table.names != self._names:
            raise ConfigError(
                f"colour table is for {', '.join(table.names)}, the detector looks for {', '.join(self._names)}"
            )
        self._table = table

    @property
    def decisions(self) -> Decisions:
        """What was decided about the blobs of the last frame; put together only when asked for."""
        judged = list(self._judged)
        for each in self._outsized:
            label, blob = each.cutout.label, each.blob
            reason: Reason = "too small" if blob.area < self._gates[label - 1][0] else "too large"
            judged.append((self._names[label - 1], Refusal(blob, reason)))
        return Decisions(self._looks, judged, self._chosen)

    def expected(self, name: str) -> tuple[float, float] | None:
        """Return where a marker is expected in the next frame, u and v in pixels; None when it was not in the last."""
        return self._tracks[name].expected

    def reset(self) -> None:
        """Forget where the markers were."""
        for memory in (self._shapes, self._sharing, self._reach, self._scale):
            memory.clear()
        self._tracks = {name: MarkerTrack() for name in self._markers}

    def detect(self, image: ImageArray) -> dict[str, Detection]:
        """Return the markers seen in a frame; one that is not seen is absent.

        Args:
            image: (H, W, 3) uint8 BGR.

        Raises:
            ConfigError: the frame is not of the detector's size.
        """
        self._require_size(image)
        self._image = image
        chosen = self._follow()
        if chosen is None:
            chosen = self._survey()
        for name in self._markers:
            if name not in chosen:
                self._tracks[name].miss()
                self._shapes.pop(name, None)
        return self._measure(image, chosen)

    def decide_everywhere(self, image: ImageArray) -> Decisions:
        """Return what would be decided about a frame if all of it was searched; changes no track.

        Args:
            image: (H, W, 3) uint8 BGR.

        Raises:
            ConfigError: the frame is not of the detector's size.
        """
        self._require_size(image)
        self._image = image
        self._survey()
        return self.decisions

    def _require_size(self, image: ImageArray) -> None:
        if image.shape != (*self._size, 3) or image.dtype != np.uint8:
            raise ConfigError(
                f"frame is {image.shape} {image.dtype}, the detector was made for {(*self._size, 3)} uint8; "
                "set width and height of the camera in rig.toml to what it delivers"
            )

    def _follow(self) -> dict[str, Candidate] | None:
        """Look for each marker where it is expected; None when one of them is not wholly there."""
        self._since_survey += 1
        if self._since_survey >= _SURVEY_FRAMES:
            return None
        looks: list[tuple[int, Region]] = []
        regions: dict[int, Region] = {}
        for name, track in self._tracks.items():
            region, label = track.region(track.margin_px, *self._size), self._labels[name]
            if region is None or (label in regions and region.overlaps(regions[label])):
                return None
            regions[label] = region
            looks.append((label, region))
        self._forget_decisions()
        candidates = self._candidates(looks, every=True) if looks else {}
        if candidates is None or len(candidates) < len(regions):
            return None
        chosen = self._best(candidates)
        return chosen if len(chosen) == len(looks) else None

    def _survey(self) -> dict[str, Candidate]:
        """Look for every marker in the whole frame."""
        self._since_survey = 0
        self._forget_decisions()
        looks = find_regions(self._image, self._table.labels)
        chosen = self._best((self._candidates(looks, every=False) or {}) if looks else {})
        missing = {name: label for name, label in self._labels.items() if name not in chosen}
        if looks := self._reach.looks(self._image, self._table, missing, chosen):
            found = self._candidates(looks, every=False, faint=True) or {}
            self._chosen = chosen = chosen | self._likeliest(found, missing)
        return chosen

    def _forget_decisions(self) -> None:
        self._looks, self._judged, self._outsized = [], [], []

    def _candidates(
        self, looks: Sequence[tuple[int, Region]], every: bool, *, faint: bool = False
    ) -> dict[str, list[Candidate]] | None:
        """Return the candidates for each marker in some regions of the frame; markers without one are absent.

        Args:
            looks: label and region.
            every: return None as soon as some blob is not wholly in its region.
            faint: whether faint colours count.
        """
        cutouts = Cutouts(self._image, self._table, looks, faint=faint)
        candidates: dict[str, list[Candidate]] = {}
        self._looks += looks
        gates = [self._gates[label - 1] for label, _ in looks]
        found = blobs_of(cutouts.own, cutouts.parts, gates, self._size, self._outsized)
        count = [0] * (len(self._names) + 1)
        for cutout, blobs in zip(cutouts.parts, found, strict=True):
            count[cutout.label] += len(blobs)
        for cutout, blobs in zip(cutouts.parts, found, strict=True):
            name = self._names[cutout.label - 1]
            alone = count[cutout.label] == 1
            for blob in blobs:
                if not blob.inside(cutout.region, self._size):
                    if every:
                        return None
                    self._judged.append((name, Refusal(blob, "clipped")))
                    continue
                track = self._track_at(name, blob)
                least_px = self._gates[cutout.label - 1][0]
                verdict = judge(cutouts, blob, cutout.label, least_px, track, alone, faint=faint)
                self._judged.append((name, verdict))
                if isinstance(verdict, Candidate):
                    candidates.setdefault(name, []).append(verdict)
        return candidates

    def _track_at(self, paint: str, blob: Blob) -> MarkerTrack:
        """Return the track of the marker that wears a paint; of two, the one that a blob continues better."""
        pair = self._sharing.wearers.get(paint)
        if pair is None:
            return self._tracks[paint]
        return max((self._tracks[name] for name in pair), key=lambda track: track.preference(*blob.middle, blob.area))

    def _best(self, candidates: Mapping[str, list[Candidate]]) -> dict[str, Candidate]:
        """Return for each marker the candidate that is most surely it; none where none is surely enough."""
        candidates = self._scale.fitting(candidates, self._tracks, self._judged)
        chosen = self._likeliest(candidates, self._names)
        self._chosen = chosen = chosen | self._share(candidates, chosen)
        return chosen

    def _likeliest(self, candidates: Mapping[str, list[Candidate]], names: Iterable[str]) -> dict[str, Candidate]:
        """Return the same for some paints of one wearer."""
        chosen: dict[str, Candidate] = {}
        for name in names:
            each = () if name in self._sharing.wearers else candidates.get(name, ())
            if each and (best := likeliest(each, self._tracks[name], self._scale.usual_px(name))):
                chosen[name] = best
        return chosen

    def _share(
        self, candidates: Mapping[str, list[Candidate]], chosen: Mapping[str, Candidate]
    ) -> dict[str, Candidate]:
        """Return which candidates of paints that both hands wear are which marker, once the patches are known."""
        shared: dict[str, Candidate] = {}
        self._sharing.see_patches({name: spot_of(chosen[name]) for name in self._sharing.patches if name in chosen})
        for paint, pair in self._sharing.wearers.items():
            likely = [each for each in candidates.get(paint, ()) if each.plausibility >= MIN_PLAUSIBILITY]
            carried = {name: self._tracks[name].expected for name in pair}
            found = self._sharing.match(paint, [spot_of(each) for each in likely], carried)
            shared |= {name: likely[number] for name, number in found.items()}
        return shared

    def _measure(self, image: ImageArray, chosen: Mapping[str, Candidate]) -> dict[str, Detection]:
        """Measure the chosen blobs of a frame."""
        windows = []
        for name, one in chosen.items():
            # At the picture's border a rim is missing, and what the gain does on the other side would not cancel.
            blob, is_cap = one.blob, self._markers[name].kind == "cap"
            whole = blob.border_share == 0.0
            windows.append(Window(image[blob.window], blob.mask, is_cap and whole, not is_cap and whole))
        found = {}
        for (name, one), centre in zip(chosen.items(), find_centres(windows), strict=True):
            blob = one.blob
            corners = None
            u, v = blob.x0 + centre.u, blob.y0 + centre.v
            if centre.shares is not None:
                shift = blob.shift[0] - blob.x0, blob.shift[1] - blob.y0
                shape = self._shapes.get(name)
                expected = None if shape is None else [(centre.u + x, centre.v + y) for x, y in shape]
                corners = find_corners(centre.shares, blob.points, shift, centre.area, expected)
                if corners is None:
                    self._shapes.pop(name, None)
                else:
                    self._shapes[name] = (corners - (centre.u, centre.v)).tolist()
                    corners += (blob.x0, blob.y0)
                    corners.setflags(write=False)
            found[name] = Detection(u, v, centre.area, probability(one.evidence), corners, blob)
            self._tracks[name].update(u, v, centre.area, (0.5 * blob.box[2], 0.5 * blob.box[3]))
        self._sharing.remember({name: one.blob.middle for name, one in chosen.items()})
        return found
