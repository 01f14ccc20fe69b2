"""The whole 3D scene of a rig: what stands still is drawn once, what moves with every frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.geometry.hull import hull_surface
from rhot.messages import BodyPose, FootPose, HandPose, HeadPose, MeshShape, ObjectPose, PointSet, Side, Truth
from rhot.object_mesh import known_mesh
from rhot.rig import Rig
from rhot_viewer.browser.camera_layer import CameraLayer, PictureClick
from rhot_viewer.browser.page import Page
from rhot_viewer.rig.inbox import Inbox
from rhot_viewer.rig.truth_track import TruthTrack
from rhot_viewer.scene.drawn import (
    LINES,
    OBJECT_COLOR,
    PREDICTED_COLOR,
    UNKNOWN_COLOR,
    HandShape,
    Trails,
    body_rods,
    fingertips,
    foot_boxes,
    ghost_shape,
    hand_shape,
    limit_lines,
    marker_balls,
    object_copies,
)
from rhot_viewer.scene.instances import Instances, Mesh, Rgb, rotation_of_z, unit_ball, unit_box, unit_rod
from rhot_viewer.scene.viewpoint import (
    Viewpoint,
    close_up,
    desk_middle,
    first_view,
    overview,
    through,
    up_direction,
    volume_lines,
)

# Objects with a surface of their own: each is sent to the browser once, and then only moved.


class MeshLayer:
    """Meshes by the object's name; from the rig folder's file, else the planes that the message carries."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        """Prepare a layer.

        Args:
            scene: where.
            name: of the node above them.
        """
        self._scene = scene
        self._name = name
        self._drawn: dict[str, tuple[MeshShape, viser.MeshHandle]] = {}

    def show(self, rig: Rig, objects: Mapping[str, ObjectPose]) -> None:
        """Show those objects whose shape is a mesh, and no others."""
        for name, (_, handle) in self._drawn.items():
            handle.visible = name in objects and isinstance(objects[name].shape, MeshShape)
        # Meshes that stay in the browser, hidden, once they have gone: a rig has about ten, but anybody may
        # make up names.
        if len(self._drawn) > 64:
            for name in [name for name, (_, handle) in self._drawn.items() if not handle.visible]:
                self._drawn.pop(name)[1].remove()
        for name, pose in objects.items():
            if isinstance(pose.shape, MeshShape):
                handle = self._handle(rig, name, pose.shape)
                x, y, z, w = pose.orientation
                handle.position, handle.wxyz = pose.position, (w, x, y, z)
                handle.color = OBJECT_COLOR if pose.state == "measured" else PREDICTED_COLOR

    def _handle(self, rig: Rig, name: str, shape: MeshShape) -> viser.MeshHandle:
        drawn = self._drawn.get(name)
        if drawn is not None and drawn[0] == shape:
            return drawn[1]
        corners, triangles = _surface(rig, name, shape)
        handle = self._scene.add_mesh_simple(
            f"{self._name}/{name}",
            corners.astype(np.float32),
            triangles.astype(np.uint32),
            color=OBJECT_COLOR,
            # A surface that somebody drew may be open.
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._drawn[name] = shape, handle
        return handle


def _surface(rig: Rig, name: str, shape: MeshShape) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    mesh = known_mesh(rig, name)
    # A recording may be of another rig: what it says counts, not what the file holds by now.
    if mesh is not None and mesh.shape == shape:
        return mesh.corners, mesh.triangles
    return hull_surface(np.array(shape.planes))


# Nodes of the 3D scene in the browser that are filled with arrays of `rhot_viewer.scene`.
#
# Everything that moves consists of copies of three unit meshes, so that a frame costs a few messages however many parts
# move; a property that has not changed is not sent again (viser compares).

GHOST_OPACITY: Final = 0.45

_LIGHT: Final = np.round(255.0 * (np.arange(256) / 255.0) ** 2.2).astype(np.uint8)
"""Colours without a screen's gamma: the browser takes those of copies as amounts of light, and adds the gamma."""

_Number = TypeVar("_Number", np.float32, np.uint8)


class InstanceLayer:
    """Copies of one mesh under one name; how many may change."""

    def __init__(self, scene: viser.SceneApi, name: str, mesh: Mesh, *, ghost: bool = False) -> None:
        """Prepare a layer.

        Args:
            scene: where.
            name: of the node.
            mesh: what is copied.
            ghost: translucent, and only its far side is drawn: around something solid it shows as a rim.
        """
        self._scene = scene
        self._name = name
        self._mesh = mesh
        self._ghost = ghost
        self._handle: viser.BatchedMeshHandle | None = None

    def show(self, copies: Instances | None) -> None:
        """Show these copies, or nothing."""
        handle = self._handle
        if copies is None or len(copies) == 0:
            if handle is not None:
                handle.visible = False
            return
        if handle is None or len(handle.batched_positions) < len(copies):
            self._handle = self._added(copies)
            return
        full = len(handle.batched_positions)
        handle.batched_positions = _filled(copies.positions, full)
        handle.batched_wxyzs = _filled(copies.wxyzs, full)
        scales = _filled(copies.scales, full)
        if full > len(copies):
            # Those that are too many have no size.
            scales = scales * (np.arange(full) < len(copies))[:, None]
        handle.batched_scales = scales
        handle.batched_colors = _LIGHT[_filled(copies.colors, full)]
        handle.visible = True

    def _added(self, copies: Instances) -> viser.BatchedMeshHandle:
        return self._scene.add_batched_meshes_simple(
            self._name,
            self._mesh.vertices,
            self._mesh.faces,
            copies.wxyzs,
            copies.positions,
            batched_scales=copies.scales,
            batched_colors=_LIGHT[copies.colors],
            opacity=GHOST_OPACITY if self._ghost else None,
            side="back" if self._ghost else "front",
            lod="off",
            # Shadows of moving things are redrawn in every frame by every browser.
            cast_shadow=False,
            receive_shadow=False,
        )


def _filled(rows: NDArray[_Number], full: int) -> NDArray[_Number]:
    """Return an array of `full` rows: those given, then the last one again and again."""
    if len(rows) == full:
        return rows
    filled: NDArray[_Number] = rows[np.minimum(np.arange(full), len(rows) - 1)]
    return filled


class HandLayer:
    """One hand: joints and bones."""

    def __init__(self, scene: viser.SceneApi, name: str, *, ghost: bool = False) -> None:
        self._joints = InstanceLayer(scene, f"{name}/joints", unit_ball(), ghost=ghost)
        self._bones = InstanceLayer(scene, f"{name}/bones", unit_rod(), ghost=ghost)

    def show(self, shape: HandShape | None) -> None:
        """Show a hand, or none."""
        self._joints.show(None if shape is None else shape.joints)
        self._bones.show(None if shape is None else shape.bones)


SIDES: Final[tuple[Side, ...]] = ("right", "left")
_HAND_AGE_S: Final = 0.4
_SLOW_AGE_S: Final = 1.0
_TRAIL_S: Final = 2.0
_FADED: Final = (96, 102, 112)
"""Where trails fade to: faint before a dark background as before a light one."""
_GRID_CELL_M: Final = 0.1


@dataclass(slots=True)
class Shown:
    """What the scene shows beside hands, markers and objects; each can be switched off in the page."""

    ghost: bool = False
    trails: bool = True
    markers: bool = True
    volume: bool = True
    cameras: bool = True
    limits: bool = False


@dataclass(slots=True)
class Seen:
    """What the last frame showed, for the panels.

    Attributes:
        hands: tracked hands by side.
        tip_errors_mm: newest distances of fingertips from the truth, by side and finger, since they were last taken.
    """

    hands: dict[str, HandPose] = field(default_factory=dict)
    tip_errors_mm: dict[str, list[float]] = field(default_factory=dict)


class RigScene:
    """The scene of one rig in one page."""

    def __init__(self, page: Page, rig: Rig, inbox: Inbox, colors: Mapping[str, Rgb]) -> None:
        """Draw what stands still: desk, volume, cameras.

        Args:
            page: an open page.
            rig: loaded.
            inbox: where messages arrive.
            colors: of the markers.
        """
        self.shown = Shown()
        self.seen = Seen()
        self._page = page
        self._rig = rig
        self._inbox = inbox
        self._colors = colors
        self._clicked: list[PictureClick] = []
        self._truth = TruthTrack()
        tips = [f"{side} {finger}" for side in SIDES for finger in FINGERS]
        self._trails = Trails(tips, _TRAIL_S)
        self._models = {side: HandModel.from_file(rig.hand, side) for side in SIDES}
        scene = page.server.scene
        scene.set_up_direction(up_direction(rig))
        scene.configure_default_lights(cast_shadow=False)
        self._volume = self._draw_desk(scene)
        self.cameras = CameraLayer(scene, rig.cameras, rig.config.sim.desk_z_m, self._picture_clicked, page.on_loop)
        self._hands = {side: HandLayer(scene, f"/hands/{side}") for side in SIDES}
        self._limits = {side: self._draw_limits(scene, side) for side in SIDES}
        self._ghosts = {side: HandLayer(scene, f"/truth/{side}", ghost=True) for side in SIDES}
        self._markers = InstanceLayer(scene, "/markers", unit_ball())
        self._boxes = InstanceLayer(scene, "/objects/boxes", unit_box())
        self._cylinders = InstanceLayer(scene, "/objects/cylinders", unit_rod())
        self._spheres = InstanceLayer(scene, "/objects/spheres", unit_ball())
        self._meshes = MeshLayer(scene, "/objects/meshes")
        self._feet = InstanceLayer(scene, "/feet", unit_box())
        self._leg_joints = InstanceLayer(scene, "/legs/joints", unit_ball())
        self._leg_bones = InstanceLayer(scene, "/legs/bones", unit_rod())
        self._labels: dict[str, viser.LabelHandle] = {}
        self._paths = scene.add_line_segments(
            "/trails",
            self._trails.lines.astype(np.float32),
            self._trails.colors({**dict.fromkeys(tips, UNKNOWN_COLOR), **_tip_colors(rig, colors)}, _FADED),
            thickness=0.0022,
        )
        self._start_with(first_view(rig))

    def _draw_desk(self, scene: viser.SceneApi) -> viser.LineSegmentsHandle:
        up = up_direction(self._rig)
        middle = desk_middle(self._rig)
        if self._rig.config.feet is not None:
            middle = np.zeros(3)
        scene.add_grid(
            "/desk",
            width=1.6,
            height=1.2,
            cell_size=_GRID_CELL_M,
            section_size=5 * _GRID_CELL_M,
            cell_color=(52, 58, 66),
            section_color=(84, 94, 108),
            plane="xy",
            position=tuple(middle),
            wxyz=tuple(rotation_of_z(up[None])[0]),
        )
        volume = volume_lines(*self._rig.config.fusion.volume_m).astype(np.float32)
        volume_color = (70, 84, 104)
        return scene.add_line_segments("/volume", volume, volume_color, thickness=0.0016)

    def _draw_limits(self, scene: viser.SceneApi, side: Side) -> viser.LineSegmentsHandle:
        nowhere = np.zeros((LINES, 2, 3), dtype=np.float32)
        limit_color = (240, 200, 90)
        return scene.add_line_segments(f"/limits/{side}", nowhere, limit_color, thickness=0.0014, visible=False)

    def _start_with(self, view: Viewpoint) -> None:
        camera = self._page.server.initial_camera
        camera.up, camera.look_at, camera.position, camera.fov = view.up, view.look_at, view.position, view.fov_rad
        camera.near = 0.01

    def on_picture_click(self, work: PictureClick) -> None:
        """Call `work` with camera and raw pixel whenever somebody clicks in a camera's picture."""
        self._clicked.append(work)

    def _picture_clicked(self, camera: str, u: float, v: float) -> None:
        for work in self._clicked:
            work(camera, u, v)

    def fly(self, client: viser.ClientHandle | None, where: str) -> None:
        """Move one browser's view: to `overview`, to the `hand`, or to a camera by its name."""
        if client is None:
            return
        if where in self.cameras.planes:
            view = through(self.cameras.planes[where], client.camera.aspect)
        elif where == "hand":
            palms = [pose.joints["palm"].position for pose in self.seen.hands.values() if "palm" in pose.joints]
            view = close_up(self._rig, np.array(palms).reshape(-1, 3))
        else:
            view = overview(self._rig)
        with client.atomic():
            client.camera.up_direction = view.up
            client.camera.position = view.position
            client.camera.look_at = view.look_at
            client.camera.fov = view.fov_rad

    def set_visible(self) -> None:
        """Bring the nodes that stand still in line with `shown`."""
        self._volume.visible = self.shown.volume
        self._paths.visible = self.shown.trails
        self.cameras.set_visible(self.shown.cameras)

    def new_session(self, rig: Rig, colors: Mapping[str, Rgb]) -> None:
        """Forget the paths of an earlier session, and show the rig as it is calibrated now."""
        self._trails.clear()
        self._truth = TruthTrack()
        self._rig, self._colors = rig, colors
        self._models = {side: HandModel.from_file(rig.hand, side) for side in SIDES}
        self.cameras.place(rig.cameras)

    def frame(self) -> None:
        """Send what has moved; all of one frame arrives together."""
        with self._page.server.atomic():
            self._show_truth()
            self._show_hands()
            points = self._inbox.newest("rhot/points", PointSet, _HAND_AGE_S) if self.shown.markers else None
            self._markers.show(None if points is None else marker_balls(points, self._colors))
            self._show_objects()
            self._show_feet()

    def _show_truth(self) -> None:
        truth = self._inbox.newest("rhot/truth", Truth, _HAND_AGE_S)
        if truth is not None:
            self._truth.add(truth)
        for side, layer in self._ghosts.items():
            joints = None if truth is None or not self.shown.ghost else truth.hands.get(side)
            layer.show(None if joints is None else ghost_shape(joints, self._models[side].radii))

    def _show_hands(self) -> None:
        hands = {side: self._inbox.newest(f"rhot/hand/{side}", HandPose, _HAND_AGE_S) for side in SIDES}
        before, self.seen.hands = self.seen.hands, {side: pose for side, pose in hands.items() if pose is not None}
        moved = False
        for side, layer in self._hands.items():
            pose = hands[side]
            layer.show(None if pose is None else hand_shape(pose))
            self._show_limits(side, pose)
            if pose is None and side in before:
                self._trails.clear(side)
                moved = True
            if pose is None or pose is before.get(side):
                continue
            moved |= self._trails.add(pose.t_ns, fingertips(side, pose))
            errors = self._truth.fingertip_errors(pose)
            if errors is not None:
                for finger, error in zip(FINGERS, errors, strict=True):
                    self.seen.tip_errors_mm.setdefault(f"{side} {finger}", []).append(1e3 * float(error))
        if moved and self.shown.trails:
            self._paths.points = self._trails.lines.astype(np.float32)

    def _show_limits(self, side: Side, pose: HandPose | None) -> None:
        lines = limit_lines(self._models[side], pose) if pose is not None and self.shown.limits else None
        self._limits[side].visible = lines is not None
        if lines is not None:
            self._limits[side].points = lines.astype(np.float32)

    def _show_objects(self) -> None:
        objects = self._inbox.all_newest("rhot/object/", ObjectPose, _SLOW_AGE_S)
        head = self._inbox.newest("rhot/head", HeadPose, _SLOW_AGE_S)
        copies = object_copies(objects, head)
        self._boxes.show(copies.boxes)
        self._cylinders.show(copies.rods)
        self._spheres.show(copies.balls)
        self._meshes.show(self._rig, objects)
        positions = {name: pose.position for name, pose in objects.items()}
        if head is not None:
            positions["head"] = head.position
        up = up_direction(self._rig)
        for name, position in positions.items():
            if name not in self._labels:
                self._labels[name] = self._page.server.scene.add_label(
                    f"/labels/{name}", name, anchor="bottom-center", font_screen_scale=0.9
                )
            self._labels[name].position = tuple(np.array(position) + 0.06 * up)
        for name in [name for name in self._labels if name not in positions]:
            self._labels.pop(name).remove()

    def _show_feet(self) -> None:
        feet = self._inbox.all_newest("rhot/foot/", FootPose, _SLOW_AGE_S)
        self._feet.show(foot_boxes(feet) if feet else None)
        body = self._inbox.newest("rhot/body", BodyPose, _SLOW_AGE_S)
        joints, bones = (None, None) if body is None else body_rods(body)
        self._leg_joints.show(joints)
        self._leg_bones.show(bones)


def _tip_colors(rig: Rig, colors: Mapping[str, Rgb]) -> dict[str, Rgb]:
    """Return the colour of the marker on each painted fingertip, by `<side> <finger>`."""
    return {
        f"{marker.hand} {marker.joint.removesuffix('_tip')}": colors[name]
        for name, marker in rig.config.markers.items()
        if marker.joint.endswith("_tip")
    }
