"""What events say of a pose: how much of the moving contour they explain, how they gather on it, which ways it faces, and whether texture agrees.

The residual does not tell: a slip onto a parallel edge has a small one.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.config.validation import ValidationConfig
from torchtrack.core.dispatch import accelerable
from torchtrack.core.host_sync import none_of
from torchtrack.core.image_velocity import MovingObjects, pixel_velocity
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association.matches import Matches
from torchtrack.tracking.association.weights import ON_CONTOUR_PX, on_and_around, patch, patch_sums
from torchtrack.tracking.contours.points import Contours

# A patch explains its contours when this ratio of the observations near them is on them.
LEAST_RATIO = 0.5


# Observations on the contours of a patch from which these are explained, unless corners alone are observed, which are few. Not measured alone.
MIN_ON_CONTOUR = 3
# Contours slower than this across themselves need not fire (px/s). Not measured alone.
MIN_SPEED_PX_S = 30.0


# Fewer moving contour points than this say nothing.
MIN_MOVING_POINTS = 16


# What has not been seen well for so long may not be held by parallel lines alone; after so much more, hardly anything is required (s). With it,
# objects of plain faces that a bar hides lose 1.8 instead of 3.8 % of their windows (docs/results.md); the numbers were not measured alone.
PARALLEL_AFTER_S, _REQUIRED_S = 0.05, 1.0
# Normals that are spread no farther than this ratio of what is required say nothing for a pose; from the other ratio on, all.
_PARALLEL_FROM, _PARALLEL_TO = 0.1, 0.33


# How far around a contour observations are that should gather on it (px).
AROUND_PX = 5.0


def explained_ratio(
    contours: Contours, matches: Matches, contour_velocity: Float[Tensor, "b m 2"], image_sizes: Int[Tensor, "b 2"], config: TrackerConfig
) -> Float[Tensor, "b"]:
    """:func:`measured_ratio`; where hardly anything moves, nothing speaks against the pose: all is explained."""
    return measured_ratio(contours, matches, contour_velocity, image_sizes, config).nan_to_num(1.0)


def measured_ratio(
    contours: Contours, matches: Matches, contour_velocity: Float[Tensor, "b m 2"], image_sizes: Int[Tensor, "b 2"], config: TrackerConfig
) -> Float[Tensor, "b"]:
    """Of the visible contour that should fire given its motion, the ratio with observations on it; not a number where hardly any moves.

    A patch of the image explains its contours when most of the observations near them are on them: a few of those that
    chance scatters around a contour always are.
    """
    counts = patch_sums(patch(matches.targets), on_and_around(matches.offsets, matches.near) * matches.as_expected[:, None])
    on, near = counts.gather(2, patch(contours.pixels)[:, None].expand(-1, 2, -1)).unbind(1)
    explained = (on >= min_on_contour(config)) & (on + 1 > LEAST_RATIO * (near + 2))
    speed = (contours.normals * contour_velocity).sum(-1).abs()
    moving = contours.mask & inside(contours.pixels, image_sizes) & (speed > MIN_SPEED_PX_S)
    total = moving.sum(-1)
    ratio = (moving & explained).sum(-1).to(contours.pixels.dtype) / total.clamp(min=1)
    return torch.where(total < MIN_MOVING_POINTS, torch.nan, ratio)


def min_on_contour(config: TrackerConfig) -> int:
    """Observations on the contours of a patch from which these are explained."""
    return MIN_ON_CONTOUR if config.association.max_events else 1


class FitMeasures(NamedTuple):
    """What events say of each pose: the functions of these names."""

    measured_ratio: Float[Tensor, "b"]
    inlier_ratio: Float[Tensor, "b"]
    normal_spread: Float[Tensor, "b"]
    texture_agreement: Float[Tensor, "b"]
    visible_ratio: Float[Tensor, "b"]


@accelerable
def fit_measures(contours: Contours, matches: Matches, objects: MovingObjects, image_sizes: Int[Tensor, "b 2"], config: TrackerConfig) -> FitMeasures:
    """What events say of poses whose contours move with their objects."""
    velocity = pixel_velocity(contours.points_cam, objects.velocity, objects.centre_cam, objects.intrinsics)
    measured, inliers = measured_ratio(contours, matches, velocity, image_sizes, config), inlier_ratio(matches, config.validation)
    agreement, visible = texture_agreement(contours, matches, config.validation), visible_ratio(contours, image_sizes)
    return FitMeasures(measured, inliers, normal_spread(matches), agreement, visible.to(measured.dtype))


def inlier_ratio(matches: Matches, config: ValidationConfig) -> Float[Tensor, "b"]:
    """Of the observations near an object's contours, the ratio that is on them; not a number where they are too few to tell.

    Contours that slipped onto others are explained by events of those, but what is around them is no longer theirs alone.
    """
    offsets = matches.offsets.abs()
    near = matches.near & (offsets < AROUND_PX)
    count = near.sum(-1)
    ratio = (near & (offsets < ON_CONTOUR_PX)).to(offsets.dtype).sum(-1) / count.clamp(min=1)
    return torch.where(count < config.min_observations, torch.nan, ratio)


def texture_agreement(contours: Contours, matches: Matches, config: ValidationConfig) -> Float[Tensor, "b"]:
    """How far the observations on an object's texture agree on which side of it is the darker one; not a number where they are too few to tell.

    On the right pose nearly all do, on another as many say this as that. Dense print explains much of the events at many poses, and no measure of
    how much tells these apart. Where edges are hardly resolved, half of the events agree on the right pose, too: so it is what observations say above
    a half, by least squares over how far their edges are resolved.
    """
    on_texture = ((contours.kind == int(ContourKind.TEXTURE)) * contours.resolved).gather(1, matches.contour)
    weights = torch.where(matches.near & (matches.offsets.abs() < ON_CONTOUR_PX), on_texture, 0)
    evidence = weights.square().sum(-1)
    agreement = 0.5 + torch.where(weights > 0, weights * (matches.as_expected - 0.5), 0).sum(-1) / evidence.clamp(min=1e-6)
    return torch.where(evidence < config.min_observations, torch.nan, agreement)


def normal_spread(matches: Matches) -> Float[Tensor, "b"]:
    """How far the normals of the contours are spread that observations lie on: 0 where all are parallel, 0.5 where none prevails.

    The smaller eigenvalue of the mean of ``n n^T`` over their unit normals n, by the resultant of these at twice their angles
    (Mardia and Jupp, Directional Statistics, 1.3).
    """
    on = on_and_around(matches.offsets, matches.near)[:, 0]
    u, v = matches.directions.detach().unbind(-1)
    doubled = torch.stack([u * u - v * v, 2 * u * v], 1)
    count = on.sum(-1)
    return 0.5 * (count - (doubled * on[:, None]).sum(-1).norm(dim=1)) / count.clamp(min=1)


def required_spread(
    reference_normal_spread: Float[Tensor, "b"], time_since_validated_s: Float[Tensor, "b"], config: TrackerConfig
) -> Float[Tensor, "b"] | None:
    """How far the normals of an object's contours have to be spread, which was not seen well for a while: as far as when it was.

    Less and less: an object may go on along its own edges, of which only those across its way fire then. None where it is certain
    that nothing is required of any object, as a rule.

    Args:
        reference_normal_spread: of when it is seen well; zero, for nothing, where that is not known.
        time_since_validated_s: how long ago that was (s).
    """
    asks = (time_since_validated_s >= PARALLEL_AFTER_S) & config.uses(Component.ALL_DIRECTIONS)
    return None if none_of(asks) else torch.where(asks, reference_normal_spread * torch.exp(time_since_validated_s / -_REQUIRED_S), 0)


def constrained_2d(spread: Float[Tensor, "b"], required: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """How far a pose is constrained in both directions of the image, 0 to 1: an object laid along a bar that hides it slides along its edges.

    Args:
        spread: :func:`normal_spread` of what is explained; ``required`` of it, zero for nothing.
    """
    ratio = (spread - _PARALLEL_FROM * required) / ((_PARALLEL_TO - _PARALLEL_FROM) * required).clamp(min=1e-6)
    return torch.where(required > 0, ratio.clamp(0, 1), 1)


def inside(pixels: Float[Tensor, "b m 2"], image_sizes: Int[Tensor, "b 2"]) -> Bool[Tensor, "b m"]:
    """Which pixels lie in the image of their object (height, width)."""
    return ((pixels >= 0) & (pixels < image_sizes.flip(-1)[:, None])).all(-1)


def visible_ratio(contours: Contours, image_sizes: Int[Tensor, "b 2"]) -> Float[Tensor, "b"]:
    """Ratio of an object's contour points that lie in the image; zero without any."""
    seen = contours.mask & inside(contours.pixels, image_sizes)
    return seen.sum(-1) / contours.mask.sum(-1).clamp(min=1)
