"""Poses worth aligning where a prediction is too uncertain: sampled from its covariance, and scored by the events on their contours.

Thousands are scored in the time that a few dozen take to be aligned. Where the prediction is so uncertain that even these hardly come
near the right one, rotations and depths alone are drawn, tried in all places of the image
(:mod:`torchtrack.tracking.relocalization.correlation`), and the best pulled onto the events
(:mod:`torchtrack.tracking.relocalization.edge_search`).
"""

from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerable
from torchtrack.core.lie import difference_about
from torchtrack.core.neighbours import over_3x3
from torchtrack.core.padded import repeated, rows_in_all
from torchtrack.tracking.contours.points import Contours, assemble
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.correlation import kept_rotations, shifted
from torchtrack.tracking.relocalization.edge_search import FAR_PX, NEAR_PX, pulled
from torchtrack.tracking.relocalization.event_image import Places, event_density, look_up
from torchtrack.tracking.relocalization.view_sphere import outlines_at, thinned

# Poses sampled near a prediction, at most, and for each of ``relocalization.rotations``. Their score alone is taken, which costs little.
_MOST_SAMPLES, _SAMPLES_PER_ROTATION = 2000, 5
# One of so many rotations that are kept is pulled onto the events once more, from nearer. With 1000 rotations, of which 512 are pulled, 64 of these
# twice, and the best aligned three times, 0.86 of 79 objects put 37° and 50 px off were found in one look, in 0.21 s; with half the rotations, an
# eighth of those pulled and the best aligned once, 0.56 in 0.15 s.
_KEPT_PER_PULLED = 8
# Events around a contour are counted this far from it (px), and more than this many of them in the same place say no more.
AROUND_PX, ENOUGH_EVENTS = 4.0, 3.0


def sample_near(prediction: Prediction, outlines: Contours, places: Places, config: TrackerConfig) -> Float[Tensor, "n 12"]:
    """Offsets of pose and velocity that are worth aligning, near predictions: see :func:`sample_anywhere`.

    Args:
        prediction: of some objects, with the covariances to sample from.
        outlines: their contours there.
        places: pixels of the events at the window's end, and which of them exist.
    """
    count = min(_MOST_SAMPLES, _SAMPLES_PER_ROTATION * config.relocalization.rotations)
    offsets = draw_offsets(prediction.covariance, count).to(prediction.velocity.dtype)
    scores = score_outlines(thinned(outlines), prediction.poses_at(offsets[:, :6]), prediction.objects.intrinsics, _enough(prediction, places))
    return _best_first(offsets, scores, len(prediction.T_cam_obj), config)


def sample_anywhere(prediction: Prediction, places: Places, config: TrackerConfig) -> Float[Tensor, "n 12"]:
    """Offsets of pose and velocity that are worth aligning, of objects that may be anywhere.

    There are ``relocalization.hypotheses`` of each object in turn; the first, the prediction itself, is none.

    Args:
        prediction: of some objects, with the covariances to sample from.
        places: pixels of the events at the window's end, and which of them exist.
    """
    enough = _enough(prediction, places)
    poses, outlines = _poses_anywhere(prediction, places, enough, config)
    T_cam_obj, centre_obj = (repeated(values, len(poses)) for values in (prediction.T_cam_obj, prediction.objects.centre_obj))
    offsets = _with_velocity(difference_about(T_cam_obj, poses, centre_obj), prediction.covariance)
    scores = score_outlines(outlines, poses, prediction.objects.intrinsics, enough)
    return _best_first(offsets, scores, len(prediction.T_cam_obj), config)


def _enough(prediction: Prediction, places: Places) -> Float[Tensor, "k h w"]:
    """How many events there are around every pixel, as far as they count."""
    return event_density(*places, prediction.objects.image_size).clamp(max=ENOUGH_EVENTS)


def _best_first(offsets: Float[Tensor, "n 12"], scores: Float[Tensor, "n"], objects: int, config: TrackerConfig) -> Float[Tensor, "m 12"]:
    """The offsets of each of some ``objects`` with the best scores, behind one that is none."""
    chosen = _best(scores, objects, config.relocalization.hypotheses - 1)
    of_objects = offsets[chosen].unflatten(0, (objects, -1))
    return torch.cat([of_objects.new_zeros(objects, 1, offsets.shape[1]), of_objects], 1).flatten(0, 1)


def _best(scores: Float[Tensor, "n"], objects: int, count: int) -> Int[Tensor, "m"]:
    """Numbers of the best rows of each of some ``objects``."""
    of_objects = scores.unflatten(0, (objects, -1))
    return rows_in_all(of_objects.topk(min(count, of_objects.shape[1])).indices, of_objects.shape[1])


def _poses_anywhere(
    prediction: Prediction, places: Places, enough: Float[Tensor, "k h w"], config: TrackerConfig
) -> tuple[Float[Tensor, "n 4 4"], Contours]:
    """Poses of very uncertain objects whose contours lie on events, and these: rotated as drawn, shifted to where most are, and pulled onto them."""
    covariance = prediction.covariance
    steps = draw_offsets(covariance, config.relocalization.rotations)[:, :6].to(prediction.velocity.dtype)
    sigma_m = covariance.diagonal(dim1=1, dim2=2)[:, 3:5].mean(1).sqrt().to(steps.dtype)
    steps, outlines = shifted(prediction, steps, sigma_m, places, config)
    onto = (over_3x3(enough, torch.add) / 9, covariance[:, :6, :6])
    poses = pulled(prediction, prediction.poses_at(steps), outlines, *onto, FAR_PX)
    count = max(kept_rotations(config) // _KEPT_PER_PULLED, config.relocalization.hypotheses)
    poses = poses[_best(score_outlines(outlines, poses, prediction.objects.intrinsics, enough), len(covariance), count)]
    # What was seen from near there does not do any more.
    poses = pulled(prediction, poses, outlines_at(prediction, poses, config), *onto, NEAR_PX)
    return poses, outlines_at(prediction, poses, config)


def draw_offsets(covariance: Float[Tensor, "k 12 12"], count: int) -> Float[Tensor, "n 12"]:
    """Offsets of pose and velocity, drawn evenly from covariances, ``count`` of each in turn; the first of these is none.

    The sequence is the same every time: a search can be repeated.
    """
    return _with_velocity((_normal(count, covariance.dtype, covariance.device) @ _root(covariance).mT).flatten(0, 1), covariance)


def _root(covariance: Float[Tensor, "k 12 12"]) -> Float[Tensor, "k 6 6"]:
    return torch.linalg.cholesky_ex(covariance[:, :6, :6]).L


def _with_velocity(pose: Float[Tensor, "n 6"], covariance: Float[Tensor, "k 12 12"]) -> Float[Tensor, "n 12"]:
    """Offsets of poses with those of the velocity: a pose that is off implies a velocity that was."""
    gain = torch.linalg.solve_ex(covariance[:, :6, :6], covariance[:, :6, 6:]).result.to(pose.dtype)
    return torch.cat([pose, (pose.unflatten(0, (len(gain), -1)) @ gain).flatten(0, 1)], -1)


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
    outlines: Contours, T_cam_obj: Float[Tensor, "n 4 4"], intrinsics: Float[Tensor, "k 4"], images: Float[Tensor, "k h w"]
) -> Float[Tensor, "n"]:
    """How much denser events are on the contours of objects at each of some poses than around them.

    Args:
        outlines: contours at each pose; or a single row for all of an object, which is moved: over a few degrees they stay contours, even of
            what is smooth.
        T_cam_obj: the poses, as many in turn of each object.
        images: how many events there are at every pixel, as :mod:`torchtrack.tracking.relocalization.event_image` has it.
    """
    count = len(T_cam_obj)
    rows = (outlines.points_obj, outlines.tangents_obj, outlines.kind, outlines.mask)
    points, tangents, kind, mask = (repeated(values, count) for values in rows)
    moved = assemble(points, tangents, kind, mask, T_cam_obj, repeated(intrinsics, count))
    number, total = repeated(torch.arange(len(images), device=images.device), count), images.new_zeros(count)
    for side_px, weight in ((0.0, 1.0), (AROUND_PX, -0.5), (-AROUND_PX, -0.5)):
        total = total + weight * (look_up(images, number, moved.pixels + side_px * moved.normals) * moved.mask).sum(-1)
    return total / moved.mask.sum(-1).clamp(min=1)


def rehearse(prediction: Prediction, config: TrackerConfig) -> None:
    """Call what the search of a very uncertain object calls and other windows do not: kernels are compiled, or read from the disk, at that."""
    alone = prediction.copies([0])
    nowhere = alone.T_cam_obj.new_zeros(1, 1, 2)
    sample_anywhere(alone, (nowhere, torch.zeros(1, 1, dtype=torch.bool)), config)
