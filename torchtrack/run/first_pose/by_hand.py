"""A pose that somebody makes by hand: what is set of it so far, and what each thing that is done in the browser makes of it.

Nothing here knows of a browser. In go actions, out come states; :mod:`torchtrack.run.first_pose.page` shows them.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.camera import Camera
from torchtrack.errors import EventDataError, PoseError, TorchtrackWarning
from torchtrack.io import EventSource
from torchtrack.run.first_pose.clicks import Ray, clicked_pixel, clicked_point
from torchtrack.run.first_pose.picks import FEWEST_PICKS, Picks, pose_of_picks
from torchtrack.run.first_pose.searching import pose_near, refined_pose
from torchtrack.run.first_pose.start import Box, Start, box_of_events
from torchtrack.run.first_pose.tracked import FirstPose
from torchtrack.tracking.relocalization.view_sphere import rotations_from
from torchtrack.tracking.start_check import check_in_view

# Events that are shown (µs), and of which the box is made where the object is put at first.
SHOWN_US, _EVENTS = 10_000, 100_000
# Of the box, the object fills so much at first; it is seen from above and from the side, so that three sides show.
_FILLED, _SEEN_FROM = 0.9, (0.6, -0.6, 0.5)


@dataclass(frozen=True)
class Moved:
    """The object was dragged to a pose."""

    T_cam_obj: Float[Tensor, "4 4"]


@dataclass(frozen=True)
class Clicked:
    """Somewhere was clicked, while the image stood at some depth (m)."""

    ray: Ray
    image_depth_m: float


@dataclass(frozen=True)
class TimeChosen:
    """Another time of the pose was chosen."""

    at_us: int


@dataclass(frozen=True)
class ShownChosen:
    """Events of another length of time are to be shown."""

    shown_us: int


class Order(Enum):
    """A button was pressed."""

    PICK = auto()
    DRAG = auto()
    UNDO = auto()
    REFINE = auto()
    SAVE = auto()


Action = Moved | Clicked | TimeChosen | ShownChosen | Order


@dataclass(frozen=True)
class HandPose:
    """A pose in the making.

    Args:
        start: model, camera, and events from the time of the pose on.
        T_cam_obj: where the object is put (float64).
        picking: whether clicks are picks; otherwise the object is dragged.
        pixels, points: what was picked: ideal pixels, and points in the object's frame (m); a pixel first, then its point.
        rough: whether the pose may be tens of degrees off; neither that of picks nor a refined one is.
        quality: share of the moving contour that events explain; NaN where it was not refined.
        shown_us: how long events are shown.
        note: what is to be said of the last action.
        saved: whether it is done.
    """

    start: Start
    T_cam_obj: Float[Tensor, "4 4"]
    picking: bool = False
    pixels: tuple[tuple[float, ...], ...] = ()
    points: tuple[tuple[float, ...], ...] = ()
    rough: bool = True
    quality: float = torch.nan
    shown_us: int = SHOWN_US
    note: str = ""
    saved: bool = False

    @property
    def awaits_point(self) -> bool:
        """Whether the pixel is picked whose point is to be next."""
        return len(self.pixels) > len(self.points)

    @property
    def result(self) -> FirstPose:
        """The pose as the other ways to one give it."""
        return FirstPose(self.T_cam_obj, self.start.at_us, self.quality)

    def after(self, action: Action, source: EventSource) -> "HandPose":
        """What an action makes of it; one that cannot be done leaves it as it is, with a note that says why.

        Args:
            action: what was done.
            source: where events of other times are read from.
        """
        try:
            return _done(replace(self, note=""), action, source)
        except (EventDataError, PoseError) as error:
            return replace(self, note=str(error))


def latest(actions: Sequence[Action]) -> list[Action]:
    """Actions without those that a later one of their kind makes pointless: of a drag, only where it has come to counts."""
    following = [*actions[1:], None]
    pairs = zip(actions, following, strict=True)
    return [action for action, after in pairs if isinstance(action, Clicked | Order) or type(after) is not type(action)]


def placed_before(start: Start) -> Float[Tensor, "4 4"]:
    """A pose to begin with (float64): the object where events are, about as large as they are, seen from above and from the side."""
    camera, model = start.camera, start.model
    try:
        box = box_of_events(start, _EVENTS)
    except EventDataError:
        box = Box(0.25 * camera.width, 0.25 * camera.height, 0.75 * camera.width, 0.75 * camera.height)
    depth_m = model.diameter_m * camera.fx / (_FILLED * float(box.size.max()))
    ray = np.append((box.centre.double().numpy() - camera.matrix[:2, 2]) / [camera.fx, camera.fy], 1.0)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = rotations_from(torch.nn.functional.normalize(torch.tensor([_SEEN_FROM], dtype=torch.float64)))[0]
    T[:3, 3] = depth_m * torch.from_numpy(ray) - T[:3, :3] @ model.centre.double()
    return T


def _done(pose: HandPose, action: Action, source: EventSource) -> HandPose:
    match action:
        case Moved(T_cam_obj):
            return replace(pose, T_cam_obj=T_cam_obj, rough=True, quality=torch.nan)
        case Clicked(ray, depth_m):
            return _picked(pose, ray, depth_m) if pose.picking else pose
        case TimeChosen(at_us):
            return _at(pose, at_us, source)
        case ShownChosen(shown_us):
            return replace(pose, shown_us=shown_us)
        case Order.PICK | Order.DRAG:
            return replace(pose, picking=action is Order.PICK)
        case Order.UNDO:
            return _without_last(pose)
        case Order.REFINE:
            return _refined(pose)
        case Order.SAVE:
            return _saved(pose)


def _at(pose: HandPose, at_us: int, source: EventSource) -> HandPose:
    start = Start.from_events(pose.start.model, pose.start.camera, source, at_us)
    note = "The picks of the other time are gone: the object has moved since." if pose.pixels else ""
    return replace(pose, start=start, pixels=(), points=(), rough=True, quality=torch.nan, note=note)


def _picked(pose: HandPose, ray: Ray, image_depth_m: float) -> HandPose:
    if not pose.awaits_point:
        pixel = clicked_pixel(ray, pose.start.camera, image_depth_m)
        return replace(pose, note="That was beside the image.") if pixel is None else replace(pose, pixels=(*pose.pixels, tuple(pixel.tolist())))
    point = clicked_point(ray.in_object(pose.T_cam_obj), pose.start.model)
    if point is None:
        return replace(pose, note="That was beside the object.")
    return _solved(replace(pose, points=(*pose.points, tuple(point.tolist()))))


def _without_last(pose: HandPose) -> HandPose:
    if pose.awaits_point:
        return replace(pose, pixels=pose.pixels[:-1])
    return _solved(replace(pose, pixels=pose.pixels[:-1], points=pose.points[:-1]))


def _solved(pose: HandPose) -> HandPose:
    """With the pose of its pairs, where there are enough of them."""
    if len(pose.points) < FEWEST_PICKS:
        return pose
    picks = Picks(np.array(pose.pixels), np.array(pose.points), "the picks")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", TorchtrackWarning)
        try:
            T_cam_obj = pose_of_picks(picks, ideal_camera(pose.start.camera))
        except PoseError as error:
            # The pair stays: it may be another one that is wrong, and one more may be all that is missing.
            return replace(pose, note=str(error))
    return replace(pose, T_cam_obj=T_cam_obj, rough=False, quality=torch.nan, note=" ".join(str(each.message) for each in caught))


def _refined(pose: HandPose) -> HandPose:
    refined = (pose_near if pose.rough else refined_pose)(pose.start, pose.T_cam_obj)
    return replace(pose, T_cam_obj=refined.T_cam_obj, rough=False, quality=refined.quality)


def _saved(pose: HandPose) -> HandPose:
    """Refused where the camera cannot see the object: it can still be put right."""
    with warnings.catch_warnings():
        # Whoever takes the pose tells what is doubtful of it.
        warnings.simplefilter("ignore", TorchtrackWarning)
        check_in_view(pose.T_cam_obj[None], [pose.start.model], [pose.start.camera])
    return replace(pose, saved=True)


def ideal_camera(camera: Camera) -> Camera:
    """The same camera without its distortion: what is shown has none."""
    return Camera(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, derived=True)
