"""Poses pulled onto the events: contour points look for them along their normals.

What is aligned later lets events look for contours, the nearest ones, and no farther than some pixels. Of a pose that is farther
off than that, contours find events better than events find contours: those in between belong to nothing, but hardly any
contour is without events (as in Harris and Stennett's RAPiD, 1990, there with edges of an image).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.tracker import SolverConfig
from torchtrack.core.dispatch import accelerable
from torchtrack.core.lie import difference_about
from torchtrack.core.linalg import inverse
from torchtrack.core.padded import repeated
from torchtrack.tracking.contours.points import Contours, reproject
from torchtrack.tracking.estimation.levenberg_marquardt import solve_pose
from torchtrack.tracking.estimation.terms import PoseProblem
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.event_image import look_up

# How far contour points look (px), a step of the solver each: of poses far off, and of those that were pulled nearer.
FAR_PX, NEAR_PX = (12.0, 8.4, 5.9), (7.2, 5.0, 3.5)
# Places that each looks at, on both sides.
LOOKS = 17
# Standard deviation of where a contour point with a single event is drawn to (px), with its share of what all have in common.
_FIND_PX = 10.0
_SOLVER = SolverConfig(iterations=1, loss="huber")


def pulled(
    prediction: Prediction,
    T_cam_obj: Float[Tensor, "n 4 4"],
    outlines: Contours,
    images: Float[Tensor, "k h w"],
    covariance: Float[Tensor, "k 6 6"],
    reaches_px: tuple[float, ...],
) -> Float[Tensor, "n 4 4"]:
    """Poses of objects, each moved to where its contours lie on events.

    Args:
        prediction: of the objects, with the ``covariance`` of their poses.
        T_cam_obj: where each begins, as many in turn of each object.
        outlines: contours of each there, or at a pose that is not far off.
        images: how many events there are at every pixel, as :mod:`torchtrack.tracking.relocalization.event_image` has it.
        reaches_px: how far contour points look, a step of the solver each.
    """
    information = (_FIND_PX**2 * inverse(covariance)).to(T_cam_obj.dtype)
    for reach_px in reaches_px:
        outlines = reproject(outlines, T_cam_obj, repeated(prediction.objects.intrinsics, len(T_cam_obj)))
        targets, weights = strongest_along_normals(outlines, images, reach_px)
        problem = _problem(prediction, outlines, targets, weights, reach_px, information)
        offset = difference_about(problem.T_prior, T_cam_obj, problem.centre_obj)
        T_cam_obj = solve_pose(problem, T_cam_obj, _SOLVER, offset).T_cam_obj
    return T_cam_obj


@accelerable
def strongest_along_normals(
    outlines: Contours, images: Float[Tensor, "k h w"], reach_px: float
) -> tuple[Float[Tensor, "n m 2"], Float[Tensor, "n m"]]:
    """Where each contour point has most events along its normal, rather near by, and how much that counts; as many outlines in turn of each image."""
    steps_px = torch.linspace(-reach_px, reach_px, LOOKS, dtype=images.dtype, device=images.device)
    looked_at = outlines.pixels[:, :, None] + steps_px[:, None] * outlines.normals[:, :, None]
    number = repeated(torch.arange(len(images), device=images.device), len(outlines.mask))
    there = look_up(images, number, looked_at) * (1 - steps_px.abs() / (reach_px + 1))
    most, place = there.max(-1)
    return torch.addcmul(outlines.pixels, outlines.normals, steps_px[place][..., None]), most * outlines.mask


def _problem(
    prediction: Prediction, outlines: Contours, targets: Tensor, weights: Tensor, reach_px: float, information: Float[Tensor, "k 6 6"]
) -> PoseProblem:
    """The least squares problem of contour points and where most events are."""
    objects, count = prediction.objects, len(targets)
    return PoseProblem(
        points_obj=outlines.points_obj,
        targets=targets,
        directions=outlines.normals,
        weights=weights,
        intrinsics=repeated(objects.intrinsics, count),
        centre_obj=repeated(objects.centre_obj, count),
        scale_px=torch.full_like(weights[:, 0], reach_px),
        T_prior=repeated(prediction.T_cam_obj, count),
        prior_information=repeated(information, count),
    )
