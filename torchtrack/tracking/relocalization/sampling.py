"""Poses worth aligning where a prediction is too uncertain: sampled from its covariance, and scored by the events on their contours.

Thousands are scored in the time that a few dozen take to be aligned. Where the prediction is so uncertain that even these hardly come
near the right one, rotations and depths alone are drawn, tried in all places of the image
(:mod:`torchtrack.tracking.relocalization.correlation`), and the best pulled onto the events
(:mod:`torchtrack.tracking.relocalization.edge_search`).
"""

from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerable
from torchtrack.core.lie import difference_about
from torchtrack.core.neighbours import over_3x3
from torchtrack.tracking.contours.points import Contours, assemble
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.correlation import kept_rotations, shifted
from torchtrack.tracking.relocalization.edge_search import FAR_PX, NEAR_PX, pulled
from torchtrack.tracking.relocalization.event_image import event_density, look_up
from torchtrack.tracking.relocalization.view_sphere import outlines_at, thinned

# Poses sampled near a prediction, at most, and for each of ``relocalization.rotations``. Their score alone is taken, which costs little.
_MOST_SAMPLES, _SAMPLES_PER_ROTATION = 2000, 5
# One of so many rotations that are kept is pulled onto the events once more, from nearer. With 1000 rotations, of which 512 are pulled, 64 of these
# twice, and the best aligned three times, 0.86 of 79 objects put 37° and 50 px off were found in one look, in 0.21 s; with half the rotations, an
# eighth of those pulled and the best aligned once, 0.56 in 0.15 s.
_KEPT_PER_PULLED = 8
# Events around a contour are counted this far from it (px), and more than this many of them in the same place say no more.
AROUND_PX, ENOUGH_EVENTS = 4.0, 3.0


def sample(
    prediction: Prediction,
    outline: Contours,
    covariance: Float[Tensor, "12 12"],
    sigma_px: float,
    places: tuple[Float[Tensor, "1 e 2"], Bool[Tensor, "1 e"]],
    config: TrackerConfig,
) -> Float[Tensor, "n 12"]:
    """Offsets of pose and velocity that are worth aligning, ``search.hypotheses`` of them; the first, the prediction itself, is none.

    Args:
        prediction: of the object alone.
        outline: its contours there.
        covariance: to sample from.
        sigma_px: what it comes to in the image.
        places: pixels of the events at the window's end, and which of them exist.
    """
    settings = config.relocalization
    enough = event_density(*places, prediction.objects.image_size).clamp(max=ENOUGH_EVENTS)
    if sigma_px > settings.wide_sigma_px:
        poses, outlines = _anywhere(prediction, covariance, places, enough, config)
        offsets = difference_about(prediction.T_cam_obj.expand(len(poses), 4, 4), poses, prediction.objects.centre_obj.expand(len(poses), 3))
        offsets = _with_velocity(offsets, covariance)
    else:
        count = min(_MOST_SAMPLES, _SAMPLES_PER_ROTATION * settings.rotations)
        offsets, outlines = draw_offsets(covariance, count).to(prediction.velocity.dtype), thinned(outline)
        poses = prediction.poses_at(offsets[:, :6])
    scores = score_outlines(outlines, poses, prediction.objects.intrinsics, enough)
    chosen = scores.topk(min(settings.hypotheses - 1, len(scores))).indices
    return torch.cat([torch.zeros_like(offsets[:1]), offsets[chosen]])


def _anywhere(
    prediction: Prediction, covariance: Tensor, places: tuple[Tensor, Tensor], enough: Float[Tensor, "h w"], config: TrackerConfig
) -> tuple[Float[Tensor, "k 4 4"], Contours]:
    """Poses of a very uncertain object whose contours lie on events, and these: rotated as drawn, shifted to where most are, and pulled onto them."""
    steps = draw_offsets(covariance, config.relocalization.rotations)[:, :6].to(prediction.velocity.dtype)
    sigma_m = covariance.diagonal()[3:5].mean().sqrt().to(steps.dtype)
    steps, outlines = shifted(prediction, steps, sigma_m, places, config)
    around = over_3x3(enough, torch.add) / 9
    onto = (around, covariance[:6, :6])
    poses = pulled(prediction, prediction.poses_at(steps), outlines, *onto, FAR_PX)
    count = max(kept_rotations(config) // _KEPT_PER_PULLED, config.relocalization.hypotheses)
    best = score_outlines(outlines, poses, prediction.objects.intrinsics, enough).topk(min(count, len(poses))).indices
    poses = poses[best]
    # What was seen from near there does not do any more.
    poses = pulled(prediction, poses, outlines_at(prediction, poses, config), *onto, NEAR_PX)
    return poses, outlines_at(prediction, poses, config)


def draw_offsets(covariance: Float[Tensor, "12 12"], count: int) -> Float[Tensor, "n 12"]:
    """Offsets of pose and velocity, drawn evenly from a covariance; the first is none.

    The sequence is the same every time: a search can be repeated.
    """
    return _with_velocity(_normal(count, covariance.dtype, covariance.device) @ _root(covariance).T, covariance)


def _root(covariance: Tensor) -> Tensor:
    return torch.linalg.cholesky_ex(covariance[:6, :6]).L


def _with_velocity(pose: Float[Tensor, "n 6"], covariance: Float[Tensor, "12 12"]) -> Float[Tensor, "n 12"]:
    """Offsets of poses with those of the velocity: a pose that is off implies a velocity that was."""
    gain = torch.linalg.solve_ex(covariance[:6, :6], covariance[:6, 6:]).result
    return torch.cat([pose, pose @ gain.to(pose.dtype)], -1)


@lru_cache(maxsize=8)
def _normal(count: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "n 6"]:
    """Normally distributed numbers, spread evenly; the first are none."""
    with torch.inference_mode(mode=False):
        even = torch.quasirandom.SobolEngine(6, scramble=False).draw(count + 1)[1:].to(device, dtype)
        normal = torch.erfinv(2 * even - 1) * 2**0.5
        normal[0] = 0
        return normal


@accelerable
def score_outlines(
    outlines: Contours, T_cam_obj: Float[Tensor, "n 4 4"], intrinsics: Float[Tensor, "1 4"], image: Float[Tensor, "h w"]
) -> Float[Tensor, "n"]:
    """How much denser events are on the contours of an object at each of some poses than around them.

    Args:
        outlines: its contours at each pose; or a single row for all, which is moved: over a few degrees they stay contours, even of what is smooth.
        T_cam_obj: the poses.
        image: how many events there are at every pixel, as :mod:`torchtrack.tracking.relocalization.event_image` has it.
    """
    count = len(T_cam_obj)
    points, tangents, kind, mask = (
        values.expand(count, *values.shape[1:]) for values in (outlines.points_obj, outlines.tangents_obj, outlines.kind, outlines.mask)
    )
    moved = assemble(points, tangents, kind, mask, T_cam_obj, intrinsics.expand(count, 4))
    total = image.new_zeros(count)
    for side_px, weight in ((0.0, 1.0), (AROUND_PX, -0.5), (-AROUND_PX, -0.5)):
        total = total + weight * (look_up(image, moved.pixels + side_px * moved.normals) * moved.mask).sum(-1)
    return total / moved.mask.sum(-1).clamp(min=1)


def rehearse(prediction: Prediction, config: TrackerConfig) -> None:
    """Call what the search of a very uncertain object calls and other windows do not: kernels are compiled, or read from the disk, at that."""
    alone = prediction.copies(0, 1)
    outline, nowhere = alone.objects.contours(alone.T_cam_obj, config.contours), alone.T_cam_obj.new_zeros(1, 1, 2)
    sample(alone, outline, alone.covariance[0], 2 * config.relocalization.wide_sigma_px, (nowhere, torch.zeros(1, 1, dtype=torch.bool)), config)
