"""The sliders of one camera: what each moves in the capture service's settings, and within which limits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

_PER_MARKER: Final = ("tolerances", "bounds")
"""Fields of `CameraSettings` that hold a value for each marker."""


@dataclass(frozen=True, slots=True)
class CameraSlider:
    """One slider.

    Attributes:
        label: for people, with its unit.
        field: of `CameraSettings`.
        part: within the field: an index in a pair, or a marker's name; None = the field itself.
        factor: slider value = factor · setting.
        low, high, step: of the slider.
        hint: what it does, one sentence.
    """

    label: str
    field: str
    part: int | str | None
    factor: float
    low: float
    high: float
    step: float
    hint: str

    def value_in(self, settings: Mapping[str, Any]) -> float | None:
        """Return where the slider stands for some settings, within its limits; None when they do not hold it."""
        value: Any = settings.get(self.field)
        try:
            value = value if self.part is None else value[self.part]
            return min(max(self.factor * float(value), self.low), self.high)
        except (TypeError, ValueError, KeyError, IndexError):
            return None

    def change_to(self, value: float, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the change of settings that a slider's new value asks for."""
        setting = value / self.factor
        if isinstance(self.part, str):
            return {self.field: {self.part: setting}}
        if self.part is None:
            return {self.field: setting}
        pair = list(settings[self.field])
        pair[self.part] = setting
        return {self.field: pair}


def camera_sliders(markers: Iterable[str]) -> tuple[CameraSlider, ...]:
    """Return the sliders of a camera that looks for some markers."""
    optics = (
        CameraSlider(
            "exposure ms",
            "exposure_s",
            None,
            1e3,
            0.1,
            30.0,
            0.1,
            "How long each row is exposed. Short keeps fast fingers sharp; no longer than one frame.",
        ),
        CameraSlider("gain", "gain", None, 1.0, 1.0, 16.0, 0.1, "Amplifies the picture and its noise."),
        CameraSlider("white: red", "white_balance", 0, 1.0, 0.5, 4.0, 0.02, "Red gain; locked, never automatic."),
        CameraSlider("white: blue", "white_balance", 1, 1.0, 0.5, 4.0, 0.02, "Blue gain; locked, never automatic."),
        CameraSlider(
            "saturation",
            "saturation",
            None,
            1.0,
            0.0,
            4.0,
            0.05,
            "Of the picture, where the camera can set it: 1 is its own, 0 is grey. More sets paints further apart.",
        ),
        CameraSlider("contrast", "contrast", None, 1.0, 0.1, 4.0, 0.05, "Of the picture: 1 is the camera's own."),
        CameraSlider("brightness", "brightness", None, 1.0, -1.0, 1.0, 0.01, "Added to the picture: 0 adds nothing."),
    )
    thresholds = tuple(
        CameraSlider(
            name,
            "tolerances",
            name,
            1.0,
            0.1,
            4.0,
            0.05,
            f"Threshold of the colour of {name}: above 1 takes in more colours, below 1 fewer.",
        )
        for name in markers
    )
    return (*optics, *thresholds)


def merged_change(first: Mapping[str, Any], then: Mapping[str, Any]) -> dict[str, Any]:
    """Return two changes of settings as one; the later wins, thresholds and bounds marker by marker."""
    merged = {**first, **then}
    for field in _PER_MARKER:
        if field in first and field in then:
            merged[field] = {**first[field], **then[field]}
    return merged
