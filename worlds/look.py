"""Random appearance of a world: paints, skin, desk, lamps, sleeve and clutter; linear RGB throughout."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from worlds.hand import MARKERS

Colour = tuple[float, float, float]

# Hue in turns, saturation, value of sRGB; a paint varies a little about one of these.
_PAINTS: Final = {
    "red": (0.995, 0.88, 0.80),
    "orange": (0.065, 0.90, 0.92),
    "yellow": (0.140, 0.85, 0.92),
    "lime": (0.235, 0.80, 0.80),
    "green": (0.375, 0.80, 0.58),
    "teal": (0.480, 0.75, 0.65),
    "light blue": (0.550, 0.60, 0.90),
    "blue": (0.610, 0.85, 0.75),
    "violet": (0.740, 0.68, 0.70),
    "magenta": (0.865, 0.78, 0.85),
    "pink": (0.940, 0.55, 0.95),
    "white": (0.600, 0.04, 0.93),
}
_APART: Final = 30.0
"""Least distance of two paints, CIELAB."""
_SKINS: Final = ((0.60, 0.36, 0.24), (0.52, 0.30, 0.19), (0.40, 0.22, 0.13), (0.27, 0.14, 0.08), (0.66, 0.43, 0.32))
_DESKS: Final = {
    "cloth": (0.012, 0.012, 0.014),
    "mat": (0.10, 0.105, 0.11),
    "wood": (0.30, 0.185, 0.105),
    "bright": (0.62, 0.61, 0.58),
}


@dataclass(frozen=True, slots=True)
class Paint:
    """One paint: its name, colour and roughness (0.15 glossy to 0.7 matt)."""

    name: str
    colour: Colour
    roughness: float


@dataclass(frozen=True, slots=True)
class Lamp:
    """An area lamp: position (mm, world), the point that it faces, size in mm, power and colour."""

    position: FloatArray
    aim: FloatArray
    size_mm: float
    power: float
    colour: Colour


@dataclass(frozen=True, slots=True)
class Thing:
    """Clutter: a box on the desk; centre x, y and size in mm, rotation in degrees."""

    centre: tuple[float, float]
    size: tuple[float, float, float]
    turn_deg: float
    colour: Colour
    metallic: bool


@dataclass(frozen=True, slots=True)
class Look:
    """Everything that a world looks like.

    Attributes:
        paints: by marker.
        skin: colour.
        desk: kind (`cloth`, `mat`, `wood`, `bright`) and colour.
        lamps: one to three.
        ambient: colour and strength of the room's light.
        sleeve: millimetres from the wrist to its cuff and its colour; None = bare arm.
        things: clutter.
        object_colour: of what is grasped.
    """

    paints: dict[str, Paint]
    skin: Colour
    desk: tuple[str, Colour]
    lamps: tuple[Lamp, ...]
    ambient: tuple[Colour, float]
    sleeve: tuple[float, Colour] | None
    things: tuple[Thing, ...]
    object_colour: Colour


def random_look(rng: np.random.Generator, span_mm: float) -> Look:
    """Draw a look.

    Args:
        rng: of the world.
        span_mm: width of the desk that the cameras see.
    """
    skin = _vary(rng, _SKINS[rng.integers(len(_SKINS))], 0.06)
    kind = str(rng.choice(list(_DESKS)))
    desk = _vary(rng, _DESKS[kind], 0.15)
    paints = _random_paints(rng, skin, desk)
    lamps = []
    count = int(rng.integers(1, 4))
    warm = rng.uniform(-1.0, 1.0)
    for place in range(count):
        turn = rng.uniform(0.0, 2 * np.pi)
        out = rng.uniform(150.0, 900.0)
        position = np.array([out * np.cos(turn), out * np.sin(turn), rng.uniform(1100.0, 1900.0)])
        own = warm + rng.uniform(-0.3, 0.3)
        colour = (1.0 + 0.10 * own, 1.0, 1.0 - 0.16 * own)
        power = rng.uniform(0.6, 1.0) * (1.0 if place == 0 else rng.uniform(0.25, 0.8))
        lamps.append(
            Lamp(position, np.array([*rng.uniform(-80, 80, 2), 0.0]), rng.uniform(150.0, 800.0), power, colour)
        )
    sleeve = None
    if rng.random() < 0.7:
        value = rng.uniform(0.02, 0.5)
        sleeve = (rng.uniform(35.0, 110.0), _srgb_hsv(rng.uniform(0, 1), rng.uniform(0.0, 0.45), value**0.45))
    return Look(
        paints=paints,
        skin=skin,
        desk=(kind, desk),
        lamps=tuple(lamps),
        ambient=((1.0, 1.0, 1.0 - 0.1 * warm), rng.uniform(0.10, 0.35)),
        sleeve=sleeve,
        things=_random_things(rng, span_mm),
        object_colour=_srgb_hsv(rng.uniform(0, 1), rng.uniform(0.0, 0.35), rng.uniform(0.25, 0.85)),
    )


def lab(colour: Colour) -> FloatArray:
    """Return CIELAB (D65) of a linear sRGB colour."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ np.array(colour)
    t = xyz / np.array([0.9505, 1.0, 1.089])
    f = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


def _random_paints(rng: np.random.Generator, skin: Colour, desk: Colour) -> dict[str, Paint]:
    while True:
        names = rng.choice(list(_PAINTS), 6, replace=False)
        gloss = rng.uniform(0.2, 0.6)
        paints = []
        for name in names:
            hue, saturation, value = _PAINTS[name]
            colour = _srgb_hsv(
                hue + rng.uniform(-0.015, 0.015), saturation * rng.uniform(0.9, 1.05), value * rng.uniform(0.9, 1.05)
            )
            paints.append(Paint(str(name), colour, float(np.clip(gloss + rng.uniform(-0.1, 0.1), 0.15, 0.7))))
        # Skin and desk are compared by chroma only: light and shade change their lightness.
        labs = np.array([lab(paint.colour) for paint in paints])
        apart = np.linalg.norm(labs[:, None, 1:] - labs[None, :, 1:], axis=-1) + 100.0 * np.eye(6)
        others = np.array([lab(skin), lab(desk)])
        off = np.linalg.norm(labs[:, None, 1:] - others[None, :, 1:], axis=-1)
        if apart.min() > _APART and off[:, 0].min() > _APART and off[np.array(names) != "white", 1].min() > 20.0:
            return dict(zip(MARKERS, paints, strict=True))


def _random_things(rng: np.random.Generator, span_mm: float) -> tuple[Thing, ...]:
    things: list[Thing] = []
    for _ in range(int(rng.integers(1, 5))):
        side = rng.choice([-1.0, 1.0])
        x, y = side * span_mm * rng.uniform(0.36, 0.46), span_mm * rng.uniform(-0.3, 0.34)
        kind = rng.integers(3)
        if kind == 0:
            size = (rng.uniform(50, 90), rng.uniform(50, 120), 1.0)
            colour, metal = _srgb_hsv(rng.uniform(0, 1), rng.uniform(0, 0.25), rng.uniform(0.4, 0.95)), False
        elif kind == 1:
            size, colour, metal = (rng.uniform(8, 14), rng.uniform(90, 160), 8.0), (0.5, 0.5, 0.5), True
        else:
            size = (rng.uniform(25, 50), rng.uniform(25, 60), rng.uniform(10, 40))
            colour, metal = _srgb_hsv(rng.uniform(0, 1), rng.uniform(0, 0.5), rng.uniform(0.1, 0.7)), False
        things.append(Thing((float(x), float(y)), size, float(rng.uniform(-60, 60)), colour, metal))
    return tuple(things)


def _vary(rng: np.random.Generator, colour: Colour, share: float) -> Colour:
    r, g, b = np.array(colour) * (1.0 + rng.uniform(-share, share)) * (1.0 + rng.uniform(-0.3, 0.3, 3) * share)
    return float(r), float(g), float(b)


def _srgb_hsv(hue: float, saturation: float, value: float) -> Colour:
    encoded = np.array(colorsys.hsv_to_rgb(hue % 1.0, min(saturation, 1.0), min(value, 1.0)))
    r, g, b = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return float(r), float(g), float(b)
