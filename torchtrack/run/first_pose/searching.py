"""The three ways to a first pose: from a box, from a rough pose, and from one that points picked by hand give."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.camera import project
from torchtrack.core.lie import transform_points
from torchtrack.errors import EventDataError, PoseError
from torchtrack.object_model.rotational_symmetry import rotation_group
from torchtrack.run.first_pose.event_lines import EventLines
from torchtrack.run.first_pose.outlines import ViewedObject
from torchtrack.run.first_pose.parts import Parts, finished
from torchtrack.run.first_pose.rotations import all_rotations, rotations_around
from torchtrack.run.first_pose.search_view import BOX_PX, SIDE_PX, SearchView
from torchtrack.run.first_pose.start import Box, Start, box_of_events
from torchtrack.run.first_pose.tracked import FOLLOWED_US, FirstPose, best_followed
from torchtrack.run.first_pose.trials import Trials, search_in_parts

# Events that are looked at, for each pixel around the box, and how many at least and at most; and the longest time of them (s).
_EVENTS_PER_PX, _FEWEST, _MOST = 12, 300, 100_000
_LONGEST_S = 1e-6 * FOLLOWED_US
# How far a box that somebody drew is off, of its size.
_BOX_ERROR = 0.15
# Poses that are followed through the first windows.
_FOLLOWED = 12
# Around a rough pose, and around one that picked points give: how far rotations go, and their steps (degrees).
_NEAR_DEG, _PICKED_DEG = (45.0, 9.0), (15.0, 5.0)


def pose_in_box(start: Start, box: Box | None = None) -> FirstPose:
    """The pose of an object in a box of the image; without one, around what moves most.

    Raises:
        EventDataError: if there are too few events in the box.
    """
    return best_followed(start, finished(poses_in_box(start, box or box_of_events(start, _MOST))))


def poses_in_box(start: Start, box: Box) -> Parts[Float[Tensor, "n 4 4"]]:
    """Poses of an object in a box of the image that are worth being followed, one of which is most likely right.

    Raises:
        EventDataError: if there are too few events in the box.
        PoseError: if the object fills a box of this shape in no rotation.
    """
    view = SearchView.of_box(start.camera, box)
    viewed = ViewedObject.of_model(start.model, view.camera)
    # As far away that its diameter fills the box: outlines are taken from there.
    depth_m = start.model.diameter_m * view.camera.fx / BOX_PX
    steps = torch.tensor([-0.05, 0.0, 0.05]) * BOX_PX
    trials = Trials(all_rotations(), depth_m, torch.tensor([0.88, 1.0, 1.13]), torch.cartesian_prod(steps, steps), None, view.box)
    return _searched(start, box, view, viewed, trials)


def pose_near(start: Start, T_cam_obj: Float[Tensor, "4 4"]) -> FirstPose:
    """The pose of an object up to some 40° and 20 % of its depth from a given one."""
    steps = torch.tensor([-0.12, -0.06, 0.0, 0.06, 0.12]) * BOX_PX
    return _around(start, T_cam_obj, _NEAR_DEG, torch.tensor([0.78, 0.86, 0.94, 1.03, 1.13, 1.25]), steps)


def refined_pose(start: Start, T_cam_obj: Float[Tensor, "4 4"]) -> FirstPose:
    """A pose that is a few degrees off, refined on the events."""
    steps = torch.tensor([-0.04, 0.0, 0.04]) * BOX_PX
    return _around(start, T_cam_obj, _PICKED_DEG, torch.tensor([0.92, 1.0, 1.08]), steps)


def _around(start: Start, T_cam_obj: Float[Tensor, "4 4"], turn_deg: tuple[float, float], scales: Tensor, steps: Tensor) -> FirstPose:
    box = projected_box(start, T_cam_obj)
    view = SearchView.of_box(start.camera, box)
    viewed = ViewedObject.of_model(start.model, view.camera)
    T_view_obj = view.from_camera(T_cam_obj[None])[0]
    centre = transform_points(T_view_obj, start.model.centre.double()[None])
    centre_px = project(centre, viewed.intrinsics[0].double())[0].float()
    rotations = rotations_around(T_view_obj[:3, :3], *turn_deg)
    trials = Trials(rotations, float(centre[0, 2]), scales, torch.cartesian_prod(steps, steps), centre_px, view.box)
    return best_followed(start, finished(_searched(start, box.grown(0.1), view, viewed, trials)))


def projected_box(start: Start, T_cam_obj: Float[Tensor, "4 4"]) -> Box:
    """The box around an object at a pose, in ideal pixels.

    Raises:
        PoseError: if it reaches behind the camera.
    """
    points_cam = transform_points(T_cam_obj.double(), start.model.extent_points.double())
    if float(points_cam[:, 2].min()) <= 0:
        raise PoseError(f"'{start.model.name}' reaches behind the camera at the given pose. Is its translation in metres?")
    return Box.around(project(points_cam, start.camera.intrinsics(torch.float64)))


def _searched(start: Start, box: Box, view: SearchView, viewed: ViewedObject, trials: Trials) -> Parts[Float[Tensor, "n 4 4"]]:
    lines = lines_in(start, box, view)
    yield
    best = yield from search_in_parts(trials, viewed, lines, rotation_group(start.model))
    return view.to_camera(best.best(_FOLLOWED).T_view_obj)


def lines_in(start: Start, box: Box, view: SearchView) -> EventLines:
    """The events in a box soon after the start, as lines of a view.

    Raises:
        EventDataError: if there are too few.
    """
    inside = box.grown(_BOX_ERROR).holds(start.pixels) & (start.age_s <= _LONGEST_S)
    numbers = inside.nonzero()[:, 0]
    wanted = int((_EVENTS_PER_PX * 2 * box.size.sum()).clamp(_FEWEST, _MOST))
    if len(numbers) < _FEWEST:
        where = f"the box ({box.u0:.0f}, {box.v0:.0f}) to ({box.u1:.0f}, {box.v1:.0f})"
        raise EventDataError(
            f"{len(numbers)} events in {where} in {1e3 * _LONGEST_S:g} ms after {start.at_us} µs, at least {_FEWEST} are needed: "
            "nothing moves there. Give another box, or a later time (--at-us)."
        )
    numbers = numbers[:wanted]
    last_s = float(start.age_s[numbers[-1]])
    # Around the box as well: what goes on there is no part of the object.
    seen = (start.age_s <= last_s) & box.grown(0.4).holds(start.pixels)
    pixels = view.pixels(start.pixels[seen])
    return EventLines.from_events(pixels, start.age_s[seen] / max(last_s, 1e-6), view.box, SIDE_PX)
