"""The cameras in the scene: the lines of their views and their live pictures, in which markers can be clicked."""

from __future__ import annotations

import colorsys
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import viser

from rhot.anatomy.markers import worn_paints
from rhot.errors import RhotError
from rhot.rig import Rig
from rhot.rig.calibration import CameraCalibration
from rhot.rig.colors import GaussianColor, HsvRangeColor, MarkerColor, load_colors
from rhot_viewer.scene.instances import Rgb
from rhot_viewer.scene.viewpoint import PicturePlane

# One colour per marker for people: that of its paint, bright enough for a screen.

logger = logging.getLogger(__name__)


def marker_colors(rig: Rig) -> dict[str, Rgb]:
    """Return a colour for each marker of a rig: from `colors.json`, or spread over the colour circle without it."""
    names = list(rig.config.markers)
    unpainted_lightness = 0.6
    spread = {
        name: _bytes(np.array(colorsys.hls_to_rgb(index / len(names), unpainted_lightness, 0.8)) * 255.0)
        for index, name in enumerate(names)
    }
    if not rig.colors_path.exists():
        return spread
    try:
        painted = load_colors(rig.colors_path).markers
    except RhotError as error:
        logger.warning("markers are shown in made-up colours: %s", error)
        return spread
    worn = worn_paints(rig.config.markers)
    return spread | {name: screen_color(painted[paint]) for name, paint in worn.items() if paint in painted}


def screen_color(color: MarkerColor) -> Rgb:
    """Return a paint's middle, made so bright that its strongest channel stands out on the page."""
    if isinstance(color, GaussianColor):
        rgb = np.array(max(color.components, key=lambda component: component.weight).rgb)
    elif isinstance(color, HsvRangeColor):
        start, end = color.hue_deg
        hue = (start + 0.5 * ((end - start) % 360.0)) % 360.0 / 360.0
        rgb = np.array(colorsys.hsv_to_rgb(hue, sum(color.saturation) / 2.0, sum(color.value) / 2.0)) * 255.0
    else:
        rgb = 0.5 * (np.array(color.low) + np.array(color.high))
    brightest_at_least = 190.0
    return _bytes(rgb * max(1.0, brightest_at_least / max(float(rgb.max()), 1.0)))


def _bytes(rgb: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Rgb:
    red, green, blue = (round(float(np.clip(channel, 0.0, 255.0))) for channel in rgb)
    return red, green, blue


LINE_COLOR: Final = (120, 150, 190)
VIEW_COLOR: Final = (48, 58, 74)
_LINE_M: Final = 0.0012

PictureClick = Callable[[str, float, float], None]
"""Takes a camera's name and the raw pixel (u, v) that was clicked in its picture."""


def show_jpeg(handle: viser.ImageHandle | viser.GuiImageHandle, jpeg: bytes) -> None:
    """Show a JPEG as it came.

    viser's public way takes pixels and codes them again, 640x480 in some milliseconds, per element and picture; the
    property that travels to the browser is set instead.
    """
    handle._data = jpeg


def dark_picture(width: int, height: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return what stands where no picture has come yet, (height, width, 3)."""
    return np.full((height, width, 3), 28, dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class _CameraNodes:
    """What is drawn of one camera: its picture's frame, its view down to the desk, its name and its picture."""

    frame: viser.LineSegmentsHandle
    view: viser.LineSegmentsHandle
    label: viser.LabelHandle
    picture: viser.ImageHandle


class CameraLayer:
    """All cameras of a rig."""

    def __init__(
        self,
        scene: viser.SceneApi,
        cameras: Mapping[str, CameraCalibration],
        desk_m: float,
        clicked: PictureClick,
        on_loop: Callable[[Callable[[viser.SceneNodePointerEvent[viser.ImageHandle]], None]], Callable[..., None]],
    ) -> None:
        """Draw the cameras.

        Args:
            scene: where.
            cameras: their geometry.
            desk_m: how far their views are drawn.
            clicked: called with whatever is clicked in a picture.
            on_loop: brings a callback to our event loop.
        """
        self.planes: dict[str, PicturePlane] = {}
        self._desk_m = desk_m
        self._nodes = {name: self._added(scene, name, camera) for name, camera in cameras.items()}
        for name, nodes in self._nodes.items():
            nodes.picture.on_click(on_loop(self._pointed(name, clicked)))
        self.place(cameras)

    @staticmethod
    def _added(scene: viser.SceneApi, name: str, camera: CameraCalibration) -> _CameraNodes:
        nowhere = np.zeros((8, 2, 3), np.float32)
        return _CameraNodes(
            scene.add_line_segments(f"/cameras/{name}/frame", nowhere, LINE_COLOR, thickness=_LINE_M),
            scene.add_line_segments(f"/cameras/{name}/view", nowhere, VIEW_COLOR, thickness=_LINE_M),
            scene.add_label(f"/cameras/{name}/label", name, anchor="bottom-center", font_screen_scale=0.9),
            scene.add_image(
                f"/cameras/{name}/picture",
                dark_picture(camera.width, camera.height),
                1.0,
                1.0,
                format="jpeg",
                cast_shadow=False,
                receive_shadow=False,
            ),
        )

    def place(self, cameras: Mapping[str, CameraCalibration]) -> None:
        """Put the cameras where a calibration has them; those that are not drawn yet stay away."""
        for name, nodes in self._nodes.items():
            if name not in cameras:
                continue
            plane = self.planes[name] = PicturePlane.of(cameras[name])
            nodes.frame.points = plane.lines.astype(np.float32)
            nodes.view.points = PicturePlane.of(cameras[name], self._desk_m).lines.astype(np.float32)
            nodes.label.position = tuple(plane.eye)
            nodes.picture.render_width, nodes.picture.render_height = plane.size_m
            nodes.picture.position, nodes.picture.wxyz = tuple(plane.center), tuple(plane.wxyz)

    def _pointed(
        self, name: str, clicked: PictureClick
    ) -> Callable[[viser.SceneNodePointerEvent[viser.ImageHandle]], None]:
        def pointed(event: viser.SceneNodePointerEvent[viser.ImageHandle]) -> None:
            pixel = self.planes[name].pixel_of_ray(np.array(event.ray_origin), np.array(event.ray_direction))
            if pixel is not None:
                clicked(name, *pixel)

        return pointed

    def show_picture(self, name: str, jpeg: bytes) -> None:
        """Show a camera's newest picture."""
        show_jpeg(self._nodes[name].picture, jpeg)

    def set_visible(self, visible: bool) -> None:
        """Show or hide all cameras."""
        for nodes in self._nodes.values():
            for node in (nodes.frame, nodes.view, nodes.label, nodes.picture):
                node.visible = visible
