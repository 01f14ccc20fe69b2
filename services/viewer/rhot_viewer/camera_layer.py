"""The cameras in the scene: the lines of their views and their live pictures, in which markers can be clicked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
import viser

from rhot.rig.calibration import CameraCalibration
from rhot_viewer.scene.cameras import PicturePlane

LINE_COLOR: Final = (120, 150, 190)
VIEW_COLOR: Final = (48, 58, 74)
_LINE_M: Final = 0.0012

PictureClick = Callable[[str, float, float], None]
"""Takes a camera's name and the raw pixel (u, v) that was clicked in its picture."""


def show_jpeg(handle: viser.ImageHandle | viser.GuiImageHandle, jpeg: bytes) -> None:
    """Show a JPEG as it came.

    viser's public way takes pixels and codes them again, 640x480 in some milliseconds, per place and picture; the
    property that travels to the browser is set instead.
    """
    handle._data = jpeg


def dark_picture(width: int, height: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return what stands where no picture has come yet, (height, width, 3)."""
    return np.full((height, width, 3), 28, dtype=np.uint8)


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
        self.planes = {name: PicturePlane.of(camera) for name, camera in cameras.items()}
        self._pictures: dict[str, viser.ImageHandle] = {}
        self._nodes: list[viser.SceneNodeHandle] = []
        for name, plane in self.planes.items():
            lines = scene.add_line_segments(
                f"/cameras/{name}/frame", plane.lines.astype(np.float32), LINE_COLOR, thickness=_LINE_M
            )
            seen = PicturePlane.of(cameras[name], desk_m).lines.astype(np.float32)
            view = scene.add_line_segments(f"/cameras/{name}/view", seen, VIEW_COLOR, thickness=_LINE_M)
            label = scene.add_label(
                f"/cameras/{name}/label", name, position=tuple(plane.eye), anchor="bottom-center", font_screen_scale=0.9
            )
            width_m, height_m = plane.size_m
            picture = scene.add_image(
                f"/cameras/{name}/picture",
                dark_picture(plane.width_px, plane.height_px),
                width_m,
                height_m,
                format="jpeg",
                position=tuple(plane.center),
                wxyz=tuple(plane.wxyz),
                cast_shadow=False,
                receive_shadow=False,
            )
            picture.on_click(on_loop(self._pointed(name, clicked)))
            self._pictures[name] = picture
            self._nodes += [lines, view, label, picture]

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
        show_jpeg(self._pictures[name], jpeg)

    def set_visible(self, visible: bool) -> None:
        """Show or hide all cameras."""
        for node in self._nodes:
            node.visible = visible
