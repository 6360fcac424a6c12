"""Poses worth trying where one prediction is too uncertain: drawn from its covariance, and marked by the events on their contours.

The more uncertain the prediction, the coarser the first look at the events: around the most promising poses others are
drawn, nearer each time, and looked at more closely. Thousands are marked in the time that a few dozen take to be aligned.
"""

import math
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from torchtrack.config.tracker import TrackerConfig
from torchtrack.constants import constant
from torchtrack.contours import Contours, assemble, select_ranked, take_points
from torchtrack.lie import retract_about
from torchtrack.prediction import Prediction

# Events beside a contour are counted this far from it (px), and more than this many of them in one place say no more.
_BESIDE_PX, _ENOUGH_EVENTS = 4.0, 3.0
# Contour points that a drawn pose is marked by, at most.
_MARKED_POINTS = 200
# Pixels around the image that events and contours may lie in.
_BORDER_PX = 2
# Each time poses are drawn anew they spread this much less; around one pose this many, of which so many are kept at the end.
_NEARER, _DRAWN_AROUND, _KEPT_OF_EACH = 0.4, 16, 2
# Events are blurred by this share of the spread (px), and never by more than this (px).
_BLUR, _MOST_BLUR_PX = 1 / 3, 8


def promising(
    prediction: Prediction,
    outline: Contours,
    covariance: Float[Tensor, "12 12"],
    sigma_px: float,
    density: Float[Tensor, "h w"],
    config: TrackerConfig,
) -> Float[Tensor, "n 13"]:
    """Offsets of pose and velocity that are worth aligning, ``search.hypotheses`` of them; the first is none.

    Args:
        prediction: of the one object.
        outline: its contours where it was looked for.
        covariance: to draw from.
        sigma_px: what it comes to in the image.
        density: from :func:`event_density`.
    """
    settings = config.search
    offsets = draw_offsets(covariance, settings.drawn).to(prediction.velocity.dtype)
    rounds = max(math.ceil(math.log(sigma_px / settings.least_sigma_px) / -math.log(_NEARER)), 0) if sigma_px > settings.wide_sigma_px else 0
    outlines, spread_px, of_each = thinned(outline), sigma_px, len(offsets)
    marks = mark(prediction, outlines, offsets, _blurred(density, spread_px if rounds else 0.0))
    for number in range(rounds):
        kept = offsets[marks.topk(min(settings.kept, len(marks))).indices]
        outlines, spread_px, of_each = outlines_at(prediction, kept, config), _NEARER * spread_px, _DRAWN_AROUND
        offsets = drawn_around(kept, _NEARER ** (number + 1), covariance)
        marks = mark(prediction, outlines, offsets, _blurred(density, spread_px if number + 1 < rounds else 0.0))
    # The prediction itself is always among those that are tried, and no pose is all by its nearest neighbours.
    best, place = marks.view(-1, of_each).topk(_KEPT_OF_EACH if rounds else min(settings.hypotheses, of_each))
    place = (place + of_each * torch.arange(len(best), device=best.device)[:, None]).flatten()
    chosen = place[best.flatten().topk(min(settings.hypotheses - 1, best.numel())).indices]
    return torch.cat([torch.zeros_like(offsets[:1]), offsets[chosen]])


def draw_offsets(covariance: Float[Tensor, "12 12"], count: int) -> Float[Tensor, "n 13"]:
    """Offsets of pose and velocity, drawn evenly from a covariance; the first is none. The swelling, last, is not drawn.

    The sequence is the same every time: a search can be repeated.
    """
    return _with_velocity(_normal(count, covariance.dtype, covariance.device) @ _root(covariance).T, covariance)


def drawn_around(offsets: Float[Tensor, "k 13"], spread: float, covariance: Float[Tensor, "12 12"]) -> Float[Tensor, "n 13"]:
    """Offsets near each of those given, the same number around every one and itself the first, by a share of the covariance's spread."""
    steps = _normal(len(offsets) * _DRAWN_AROUND, offsets.dtype, offsets.device).view(_DRAWN_AROUND, len(offsets), 6).transpose(0, 1)
    steps = torch.cat([torch.zeros_like(steps[:, :1]), steps[:, 1:]], 1) @ (spread * _root(covariance).T).to(offsets.dtype)
    return _with_velocity((offsets[:, None, :6] + steps).flatten(0, 1), covariance)


def _root(covariance: Tensor) -> Tensor:
    return torch.linalg.cholesky_ex(covariance[:6, :6]).L


def _with_velocity(pose: Float[Tensor, "n 6"], covariance: Float[Tensor, "12 12"]) -> Float[Tensor, "n 13"]:
    """Offsets of poses with those of the velocity: a pose that is off implies a velocity that was."""
    gain = torch.linalg.solve_ex(covariance[:6, :6], covariance[:6, 6:]).result
    return pad(torch.cat([pose, pose @ gain.to(pose.dtype)], -1), (0, 1))


@lru_cache(maxsize=8)
def _normal(count: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "n 6"]:
    """Normally distributed numbers, spread evenly; the first are none."""
    with torch.inference_mode(mode=False):
        even = torch.quasirandom.SobolEngine(6, scramble=False).draw(count + 1)[1:].to(device, dtype)
        normal = torch.erfinv(2 * even - 1) * 2**0.5
        normal[0] = 0
        return normal


def event_density(pixels: Float[Tensor, "1 e 2"], mask: Bool[Tensor, "1 e"], image_size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """Events in the 3x3 pixels around every pixel of the image with its border."""
    height, width = (size + 2 * _BORDER_PX for size in image_size)
    place = (pixels[0].round() + _BORDER_PX).nan_to_num(-1)
    inside = mask[0] & (place >= 1).all(-1) & (place[:, 0] < width - 1) & (place[:, 1] < height - 1)
    u, v = torch.where(inside[:, None], place, 0).long().unbind(-1)
    image = torch.zeros(height * width, dtype=pixels.dtype, device=pixels.device)
    image = image.scatter_add(0, v * width + u, inside.to(pixels.dtype)).view(height, width)
    rows = image[:-2] + image[1:-1] + image[2:]
    return pad(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:], (1, 1, 1, 1))


def _blurred(density: Float[Tensor, "h w"], spread_px: float) -> tuple[Float[Tensor, "h w"], int]:
    """What is on every pixel, in the mean over as many around it as a spread asks for, and how many to each side these are."""
    radius = min(round(_BLUR * spread_px), _MOST_BLUR_PX)
    enough = density.clamp(max=_ENOUGH_EVENTS)
    if radius:
        # One way after the other: a square at once takes many times as long.
        for side, to_side in (((2 * radius + 1, 1), (radius, 0)), ((1, 2 * radius + 1), (0, radius))):
            enough = avg_pool2d(enough[None], side, 1, to_side)[0]
    return enough, radius


def thinned(contours: Contours) -> Contours:
    """Of each object's contour points as many as poses are marked by."""
    chosen, exists = select_ranked(contours.mask, _MARKED_POINTS)
    kind = contours.kind.gather(1, chosen)
    points_obj, tangents_obj, points_cam, pixels, normals = (
        take_points(values, chosen) for values in (contours.points_obj, contours.tangents_obj, contours.points_cam, contours.pixels, contours.normals)
    )
    return Contours(points_obj, tangents_obj, kind, exists, points_cam, pixels, normals)


def outlines_at(prediction: Prediction, offsets: Float[Tensor, "k 13"], config: TrackerConfig) -> Contours:
    """The contours of one object as seen at each of some poses."""
    copies = prediction.copies(0, len(offsets)).moved(offsets)
    return thinned(copies.objects.contours(copies.T_cam_obj, config.contours))


def mark(prediction: Prediction, outlines: Contours, offsets: Float[Tensor, "n 13"], seen: tuple[Float[Tensor, "h w"], int]) -> Float[Tensor, "n"]:
    """How much denser events are on the contours of each pose than beside them.

    The contours are those of a pose nearby, moved: over a few degrees they stay contours, even on a smooth surface.

    Args:
        prediction: of the one object.
        outlines: contours that the poses share, the same number of poses to each in turn.
        seen: what is on every pixel, and how far around it that is from (px).
    """
    image, radius = seen
    count, objects = len(offsets), prediction.objects
    poses = retract_about(prediction.T_cam_obj.expand(count, 4, 4), offsets[:, :6], objects.centre_obj.expand(count, 3))
    of_each = torch.arange(len(outlines.mask), device=offsets.device).repeat_interleave(count // len(outlines.mask))
    points, tangents, kind, mask = (
        values.index_select(0, of_each) for values in (outlines.points_obj, outlines.tangents_obj, outlines.kind, outlines.mask)
    )
    moved = assemble(points, tangents, kind, mask, poses, objects.intrinsics.expand(count, 4))
    limit = constant((image.shape[1] - 1, image.shape[0] - 1), image.dtype, image.device)
    total, beside_px = image.new_zeros(count), _BESIDE_PX + 2 * radius
    for side_px, weight in ((0.0, 1.0), (beside_px, -0.5), (-beside_px, -0.5)):
        u, v = torch.minimum(((moved.pixels + side_px * moved.normals).round() + _BORDER_PX).clamp(min=0), limit).long().unbind(-1)
        total = total + weight * (image.flatten()[v * image.shape[1] + u] * moved.mask).sum(-1)
    return total / moved.mask.sum(-1).clamp(min=1)
