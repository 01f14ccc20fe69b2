"""Detect all markers of a frame in one pass.

While all markers are at their predicted positions, only windows around these are searched. If one is not, and twice a
second in any case, the whole frame is searched, so that a lost marker is found anywhere; the tracks only decide between
several blobs of a colour. Markers that are still missing are searched for by fainter colours near the other markers of
their hand (`reach`). All windows are classified together and measured by the same method.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rhot.anatomy.markers import PaintedMarker, own_paints, worn_paints
from rhot.arrays import ImageArray
from rhot.errors import ConfigError
from rhot.geometry.hull import Region
from rhot_capture.detection.blob import Blob, Outsized, blobs_of
from rhot_capture.detection.candidates import MIN_PLAUSIBILITY, Candidate, Reason, Refusal, judge, likeliest
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.corners import find_corners
from rhot_capture.detection.cutouts import Cutouts
from rhot_capture.detection.hand.evidence import HandAxis, HandReach, HandScale, SkinContact
from rhot_capture.detection.hand.sharing import SharedPaints, spot_of
from rhot_capture.detection.light import Light, Paint
from rhot_capture.detection.result import Decisions, Detection
from rhot_capture.detection.score import probability
from rhot_capture.detection.subpixel.batch import find_centres
from rhot_capture.detection.subpixel.windows import BlobWindow
from rhot_capture.detection.track import MarkerTrack, find_regions


class MarkerDetector:
    """Detects all markers in the frames of one camera."""

    def __init__(self, markers: Mapping[str, PaintedMarker], table: ColorTable, width: int, height: int) -> None:
        """Build the detector for frames of one size.

        Args:
            markers: by name.
            table: for the paints of these markers, in this order.
            width: of the frames, pixels.
            height: of the frames, pixels.

        Raises:
            ConfigError: the table is for other markers.
        """
        self._markers = dict(markers)
        self._names = tuple(own_paints(markers))
        self._labels = {name: self._names.index(paint) + 1 for name, paint in worn_paints(markers).items()}
        self._gates = [(markers[name].min_area_px, markers[name].max_area_px) for name in self._names]
        self._sharing = SharedPaints(markers)
        self._reach = HandReach(markers)
        self._scale = HandScale(markers)
        self._contact, self._axis = SkinContact(markers), HandAxis(markers)
        self._size = (height, width)
        self._tracks = {name: MarkerTrack() for name in markers}
        # Corners of patches in the last frame, relative to their centres.
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
        """The colours in use, in the light of the last frames; may be replaced between frames."""
        return self._table

    @table.setter
    def table(self, table: ColorTable) -> None:
        if table.names != self._names:
            raise ConfigError(
                f"the colour table is for {', '.join(table.names)}, but the detector is for {', '.join(self._names)}"
            )
        self._table = self._calibrated = table
        self._light = Light()

    @property
    def decisions(self) -> Decisions:
        """Decisions about the blobs of the last frame; computed on demand."""
        judged = list(self._judged)
        for each in self._outsized:
            label, blob = each.cutout.label, each.blob
            reason: Reason = "too small" if blob.area < self._gates[label - 1][0] else "too large"
            judged.append((self._names[label - 1], Refusal(blob, reason)))
        return Decisions(self._looks, judged, self._chosen)

    def expected(self, name: str) -> tuple[float, float] | None:
        """Return a marker's predicted u and v in the next frame, pixels; None if it was not in the last one."""
        return self._tracks[name].expected

    def reset(self) -> None:
        """Discard all tracks."""
        for memory in (self._shapes, self._sharing, self._reach, self._scale, self._contact, self._axis):
            memory.clear()
        self._tracks = {name: MarkerTrack() for name in self._markers}

    def detect(self, image: ImageArray) -> dict[str, Detection]:
        """Return the markers detected in a frame; markers that are not visible are absent.

        Args:
            image: (H, W, 3) uint8 BGR.

        Raises:
            ConfigError: the frame has another size than the detector.
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
        found = self._measure(image, chosen)
        if self._light.is_due() and self._light.look(self._calibrated, self._paints(image, chosen), self._paints_by):
            self._table = self._light.on(self._calibrated)
        return found

    @property
    def light(self) -> tuple[float, float]:
        """Red and blue of the light, relative to green, as factors on those of the calibration."""
        red, blue = np.exp(self._light.shift).tolist()
        return red, blue

    def _paints(self, image: ImageArray, chosen: Mapping[str, Candidate]) -> list[Paint]:
        return [
            (self._labels[name], image[one.blob.window], one.blob.mask)
            for name, one in chosen.items()
            if one.blob.border_share == 0.0
        ]

    def _paints_by(self, table: ColorTable) -> list[Paint]:
        """Return what would be found in this frame by another table, with no memory of others."""
        other = MarkerDetector(self._markers, table, *self._size[::-1])
        other.decide_everywhere(self._image)
        return self._paints(self._image, other._chosen)

    def decide_everywhere(self, image: ImageArray) -> Decisions:
        """Search a whole frame and return the decisions; does not update the tracks.

        Args:
            image: (H, W, 3) uint8 BGR.

        Raises:
            ConfigError: the frame has another size than the detector.
        """
        self._require_size(image)
        self._image = image
        self._survey()
        return self.decisions

    def _require_size(self, image: ImageArray) -> None:
        if image.shape != (*self._size, 3) or image.dtype != np.uint8:
            raise ConfigError(
                f"the frame is {image.shape} {image.dtype}, but the detector is for {(*self._size, 3)} uint8; "
                "set width and height of the camera in rig.toml to the size of its frames"
            )

    def _follow(self) -> dict[str, Candidate] | None:
        """Search each marker's predicted region; return None unless all markers are completely inside."""
        self._since_survey += 1
        # Interval at which the whole frame is searched even if no marker is missing: half a second at 60 Hz.
        # Chosen.
        if self._since_survey >= 30:
            return None
        looks: list[tuple[int, Region]] = []
        regions: dict[int, Region] = {}
        for name, track in self._tracks.items():
            region, label = track.region(track.margin_px, *self._size), self._labels[name]
            if region is None or (label in regions and region.overlaps(regions[label])):
                return None
            regions[label] = region
            looks.append((label, region))
        self._clear_decisions()
        candidates = self._candidates(looks, every=True) if looks else {}
        if candidates is None or len(candidates) < len(regions):
            return None
        chosen = self._best(candidates)
        return chosen if len(chosen) == len(looks) else None

    def _survey(self) -> dict[str, Candidate]:
        """Search the whole frame for all markers."""
        self._since_survey = 0
        self._clear_decisions()
        looks = find_regions(self._image, self._table.labels)
        chosen = self._best((self._candidates(looks, every=False) or {}) if looks else {})
        missing = {name: label for name, label in self._labels.items() if name not in chosen}
        if looks := self._reach.looks(self._image, self._table, missing, chosen):
            found = self._on_hand(self._candidates(looks, every=False, faint=True) or {})
            self._chosen = chosen = chosen | self._likeliest(found, missing)
        return chosen

    def _clear_decisions(self) -> None:
        self._looks, self._judged, self._outsized = [], [], []

    def _candidates(
        self, looks: Sequence[tuple[int, Region]], every: bool, *, faint: bool = False
    ) -> dict[str, list[Candidate]] | None:
        """Return the candidates for each marker in regions of the frame; markers without one are absent.

        Args:
            looks: label and region.
            every: return None if a blob is not completely inside its region.
            faint: whether to include faint colours.
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
        """Return the track of the marker with a paint; of two markers, the track that fits the blob better."""
        pair = self._sharing.wearers.get(paint)
        if pair is None:
            return self._tracks[paint]
        return max((self._tracks[name] for name in pair), key=lambda track: track.preference(*blob.middle, blob.area))

    def _best(self, candidates: Mapping[str, list[Candidate]]) -> dict[str, Candidate]:
        """Return the most plausible candidate of each marker; markers without a plausible one are absent."""
        candidates = self._on_hand(self._scale.fitting(candidates, self._tracks, self._judged))
        chosen = self._likeliest(candidates, self._names)
        self._chosen = chosen = chosen | self._share(candidates, chosen)
        return chosen

    def _on_hand(self, candidates: Mapping[str, list[Candidate]]) -> Mapping[str, list[Candidate]]:
        """Return those candidates that can be on the hand: not apart from its skin, and not behind its wrist."""
        candidates = self._axis.fitting(candidates, self._judged)
        return self._contact.fitting(candidates, self._tracks, self._judged, self._image, self._table.skin)

    def _likeliest(self, candidates: Mapping[str, list[Candidate]], names: Iterable[str]) -> dict[str, Candidate]:
        """Return the same for those of the paints that only one hand has."""
        chosen: dict[str, Candidate] = {}
        for name in names:
            each = () if name in self._sharing.wearers else candidates.get(name, ())
            if each and (best := likeliest(each, self._tracks[name], self._scale.usual_px(name))):
                chosen[name] = best
        return chosen

    def _share(
        self, candidates: Mapping[str, list[Candidate]], chosen: Mapping[str, Candidate]
    ) -> dict[str, Candidate]:
        """Return the candidates of markers whose paint both hands have; needs the patches in `chosen`."""
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
            # At the image border a part of the rim is missing, so the effect of the gain on the rest would not cancel.
            blob, is_cap = one.blob, self._markers[name].kind == "cap"
            whole = blob.border_share == 0.0
            windows.append(BlobWindow(image[blob.window], blob.mask, is_cap and whole, not is_cap and whole))
        found, shares = {}, {}
        for (name, one), centre in zip(chosen.items(), find_centres(windows, self._table.skin), strict=True):
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
            score, shares[name] = probability(one.evidence), centre.skin_share
            found[name] = Detection(u, v, centre.area, score, corners, blob, centre.skin_side)
            self._tracks[name].update(u, v, centre.area, (0.5 * blob.box[2], 0.5 * blob.box[3]))
        self._contact.update(shares)
        self._axis.update({name: (one.u, one.v, one.area) for name, one in found.items()}, self._shapes)
        self._sharing.remember({name: one.blob.middle for name, one in chosen.items()})
        return found
