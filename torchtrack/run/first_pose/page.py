"""The page of a pose that is made by hand: the only file that knows of viser, which serves it.

The world of the page is the camera's frame, in diameters of the object. The image stands behind the object, where the camera sees its pixels,
and the contours lie on it. What is done on the page comes out of :meth:`PosePage.wait` as actions; callbacks run in threads of the server and
do no more than to pass them on.
"""

import contextlib
import io
import math
import queue
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from torchtrack.core.camera import Camera
from torchtrack.core.lie import quaternion_from_rotation, rotation_from_quaternion, transform_points
from torchtrack.errors import OutputError
from torchtrack.io.extras import optional
from torchtrack.run.first_pose.by_hand import Action, Clicked, HandPose, Moved, Order, ShownChosen, TimeChosen, latest
from torchtrack.run.first_pose.clicks import Ray
from torchtrack.run.first_pose.event_view import ContourView, event_image
from torchtrack.run.first_pose.picks import FEWEST_PICKS

# Of the server: the package, the extra that brings it, and what it is for.
PACKAGE = ("viser", "viz", "making a pose in the browser")
HOST = "127.0.0.1"
# The image stands so many times as far away as the object's farthest point, at least; contours lie so much before it.
_BEHIND, _BEFORE_IMAGE = 1.5, 0.998
# More than the image is seen, by so much.
_MARGIN = 1.15
_RED, _YELLOW, _GREY, _SEEN_THROUGH = (255, 60, 60), (255, 220, 0), (160, 170, 190), 0.3
_STEP_MS, _SHOWN_MS = 1, (1, 50)
_BUTTONS = (
    (Order.DRAG, "Drag the object", "Move and turn it with the arrows and arcs."),
    (
        Order.PICK,
        "Pick pairs of points",
        "A pixel of the image, then the point of the object that is seen there.",
    ),
    (Order.UNDO, "Undo the last pick", None),
    (Order.REFINE, "Refine", "Pull the pose onto the events; from up to 40° off."),
    (Order.SAVE, "Save", "Write the pose, and end."),
)


@dataclass(frozen=True)
class Span:
    """The times that can be chosen.

    Args:
        start_us, end_us: the first and the last.
    """

    start_us: int
    end_us: int


def check_browser() -> None:
    """Raise MissingExtraError where viser is not installed."""
    optional("viser", *PACKAGE)


def angle_of_view(camera: Camera) -> float:
    """The vertical angle (rad) that the page looks with at first, from where the camera is and along its axis: more than that of the image."""
    half = max(camera.cy, camera.height - 1 - camera.cy) / camera.fy
    return 2 * math.atan(_MARGIN * half)


class PosePage:
    """Serves the page.

    Args:
        pose: what is shown at first.
        label: what the object is called.
        span: times to choose from.
        port: where it is served; the next free one where that is taken.

    Raises:
        MissingExtraError: if viser is not installed.
        OutputError: if no port can be had.
    """

    def __init__(self, pose: HandPose, label: str, span: Span, port: int) -> None:
        viser = optional("viser", *PACKAGE)
        self._model, self._camera, self._label, self._span = pose.start.model, pose.start.camera, label, span
        self._unit_m = self._model.diameter_m
        self._contours = ContourView.of_model(self._model, self._camera)
        self._actions: queue.SimpleQueue[Action] = queue.SimpleQueue()
        self._image_key: tuple[int, int] | None = None
        self._picks: list[Any] = []
        self._image_depth = 0.0
        self._server = _served(viser, port)
        self.url = f"http://localhost:{self._server.get_port()}"
        self._add_scene(pose)
        self._add_panel(pose)
        self.show(pose)

    def wait(self) -> list[Action]:
        """What was done since the last call; waits until there is something."""
        actions = [self._actions.get()]
        while not self._actions.empty():
            actions.append(self._actions.get())
        return latest(actions)

    def show(self, pose: HandPose, *, dragged: bool = False) -> None:
        """Show a state.

        Args:
            pose: the state.
            dragged: whether somebody holds the object: it is not moved then, as it may be farther on already.
        """
        with self._server.atomic():
            if not dragged:
                self._place(pose)
            self._show_image(pose)
            self._show_picks(pose)
        self._panel.content = panel_text(pose, self._label)

    def tell_busy(self, text: str) -> None:
        """Say that something takes a while."""
        self._panel.content = f"**{text}**"

    def close(self) -> None:
        """End the server."""
        with _quiet():
            self._server.flush()
            self._server.stop()

    def _add_scene(self, pose: HandPose) -> None:
        scene, camera = self._server.scene, self._camera
        scene.set_up_direction("-y")
        view = self._server.initial_camera
        view.position, view.look_at, view.fov = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), angle_of_view(camera)
        image = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._image = scene.add_image("/image", image, camera.width / camera.fx, camera.height / camera.fy, format="png", cast_shadow=False)
        self._lines = scene.add_line_segments("/contours", np.zeros((0, 2, 3)), _RED, thickness=3.0, thickness_units="screen")
        self._gizmo = scene.add_transform_controls("/object", scale=0.7, depth_test=False)
        self._gizmo.on_update(lambda event: self._actions.put(Moved(self._dragged_pose())))
        self._add_model()
        scene.on_click()(self._pass_click)

    def _add_model(self) -> None:
        """The model about its middle, which the arrows to drag it are at: one to see through while it is dragged, one to pick points on."""
        scene, mesh, middle = self._server.scene, self._model.mesh, self._model.centre.double().numpy()
        if mesh is None:
            lines = (self._model.segments.double().numpy() - middle) / self._unit_m
            size = {"thickness": 3.0, "thickness_units": "screen"}
            self._ghost, self._solid = (scene.add_line_segments(f"/object/{name}", lines, _YELLOW, **size) for name in ("ghost", "solid"))
            return
        size = {"scale": 1 / self._unit_m, "position": tuple(-middle / self._unit_m), "cast_shadow": False}
        self._ghost = scene.add_mesh_simple("/object/ghost", mesh.vertices, mesh.faces, color=_GREY, opacity=_SEEN_THROUGH, **size)
        self._solid = scene.add_mesh_trimesh("/object/solid", mesh, **size)

    def _pass_click(self, event: Any) -> None:
        ray = Ray(self._unit_m * np.array(event.ray_origin, np.float64), np.array(event.ray_direction, np.float64))
        self._actions.put(Clicked(ray, self._unit_m * self._image_depth))

    def _add_panel(self, pose: HandPose) -> None:
        gui = self._server.gui
        gui.set_panel_label("torchtrack pose")
        gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        gui.main_panel.dock_right()
        self._panel = gui.add_markdown("")
        longest_ms = max((self._span.end_us - self._span.start_us) / 1000, _STEP_MS)
        at_ms = (pose.start.at_us - self._span.start_us) / 1000
        times = gui.add_slider("ms after the start", min=0, max=longest_ms, step=_STEP_MS, initial_value=at_ms)
        times.on_update(lambda event: self._actions.put(TimeChosen(self._span.start_us + round(1000 * times.value))))
        shown = gui.add_slider("ms of events", min=_SHOWN_MS[0], max=_SHOWN_MS[1], step=1, initial_value=pose.shown_us // 1000)
        shown.on_update(lambda event: self._actions.put(ShownChosen(1000 * int(shown.value))))
        for order, label, hint in _BUTTONS:
            gui.add_button(label, hint=hint).on_click(self._passes(order))
        gui.add_button("Look from the camera", hint="Undo how the view was turned.").on_click(self._look_from_camera)

    def _passes(self, order: Order) -> Callable[[Any], None]:
        return lambda event: self._actions.put(order)

    def _look_from_camera(self, event: Any) -> None:
        view = self._server.initial_camera
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position, client.camera.look_at, client.camera.fov = view.position, view.look_at, view.fov
                client.camera.up_direction = (0.0, -1.0, 0.0)

    def _place(self, pose: HandPose) -> None:
        """The object to its pose; while a pixel is to be picked it would stand in the way of it."""
        rotation = pose.T_cam_obj[:3, :3]
        middle = rotation @ self._model.centre.double() + pose.T_cam_obj[:3, 3]
        self._gizmo.wxyz, self._gizmo.position = quaternion_from_rotation(rotation)[[3, 0, 1, 2]].numpy(), middle.numpy() / self._unit_m
        self._gizmo.disable_axes = self._gizmo.disable_sliders = self._gizmo.disable_rotations = pose.picking
        self._ghost.visible, self._solid.visible = not pose.picking, pose.picking and pose.awaits_point

    def _dragged_pose(self) -> Float[Tensor, "4 4"]:
        w, x, y, z = (float(value) for value in self._gizmo.wxyz)
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = rotation_from_quaternion(torch.tensor([x, y, z, w], dtype=torch.float64))
        middle = self._unit_m * torch.from_numpy(np.array(self._gizmo.position, np.float64))
        T[:3, 3] = middle - T[:3, :3] @ self._model.centre.double()
        return T

    def _show_image(self, pose: HandPose) -> None:
        """The events, and the contours on them."""
        points = transform_points(pose.T_cam_obj, self._model.extent_points.double())
        farthest = float(points[:, 2].max()) / self._unit_m
        if farthest > self._image_depth or self._image_depth == 0.0:
            self._image_depth = max(_BEHIND * farthest, 1.0)
            self._image.scale, self._image.position = self._image_depth, self._on_image(self._middle_pixel)[0]
        if (pose.start.at_us, pose.shown_us) != self._image_key:
            self._image_key = pose.start.at_us, pose.shown_us
            self._image.image = np.repeat(event_image(pose.start, pose.shown_us)[..., None], 3, 2)
        self._lines.points = _BEFORE_IMAGE * self._on_image(self._contours.lines(pose.T_cam_obj))

    @property
    def _middle_pixel(self) -> Float[ndarray, "1 2"]:
        return np.array([[self._camera.width - 1, self._camera.height - 1]]) / 2

    def _on_image(self, pixels: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 3"]:
        """Where ideal pixels lie on the image."""
        camera = self._camera
        rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        return self._image_depth * np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], -1)

    def _show_picks(self, pose: HandPose) -> None:
        """A number beside each pixel, and one beside each point of the object."""
        for label in self._picks:
            label.remove()
        pixels = _BEFORE_IMAGE * self._on_image(np.array(pose.pixels).reshape(-1, 2))
        points = (np.array(pose.points).reshape(-1, 3) - self._model.centre.double().numpy()) / self._unit_m
        self._picks = [*self._labels("/pixels", pixels), *self._labels("/object/points", points)]

    def _labels(self, name: str, places: Float[ndarray, "n 3"]) -> list[Any]:
        add = self._server.scene.add_label
        return [add(f"{name}/{number}", str(number), position=place, anchor="center-center") for number, place in enumerate(places, 1)]


def panel_text(pose: HandPose, label: str) -> str:
    """What is said of a state: what to do next, how many pairs there are, how good the pose is."""
    x, y, z = pose.T_cam_obj[:3, 3].tolist()
    lines = [f"**{label}** at {pose.start.at_us} µs", f"translation {x:.4g}, {y:.4g}, {z:.4g} m"]
    if pose.picking:
        next_pick = "the point of the object that is seen there" if pose.awaits_point else "a pixel of the image that you recognise"
        lines.append(f"{len(pose.points)} pairs ({FEWEST_PICKS} or more give a pose). Click on {next_pick}.")
    if not math.isnan(pose.quality):
        lines.append(f"Events explain {100 * pose.quality:.0f} % of its moving contour.")
    if pose.note:
        lines.append(f"*{pose.note}*")
    return "\n\n".join(lines)


def _served(viser: Any, port: int) -> Any:
    try:
        with _quiet():
            return viser.ViserServer(host=HOST, port=port, verbose=False)
    except OSError as error:
        raise OutputError(f"port {port}: the page cannot be served there: {error.strerror or error}. Give another one, with --port.") from error


def _quiet() -> contextlib.AbstractContextManager[Any]:
    """Without what the server says on standard output: that is for the pose."""
    return contextlib.redirect_stdout(io.StringIO())
