"""Association of corners and events with contours, with gates, and moved to the window's end.

Many observations look their nearest contour point up in an index: an image of the region in which every pixel holds the
nearest contour point. It is made once per extraction; when the pose moves by a few pixels, the observation is moved
back instead. Corners may search along their flow, as the paper does.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.camera import MIN_DEPTH_M
from torchtrack.config.tracker import MatchingConfig
from torchtrack.contours import ContourKind, Contours, select_ranked, take_points

# Squared distances are compared in these fractions of a pixel².
_DISTANCE_STEPS = 16
# An edge this parallel to the flow (|n·f| below) is not crossed by it.
_MIN_CROSSING = 0.3
# Contours slower than this across themselves (px/s) have no clear leading side.
_SLOW_PX_S = 10.0


@dataclass(frozen=True)
class Observations:
    """What was seen, padded: corners and events.

    Args:
        pixels: ideal pixels at the time of the event.
        age_s: time from the event to the window's end (s).
        polarity: +1 where the pixel got brighter, -1 where darker, 0 where unknown.
        mask: which entries exist.
        flow: velocity (px/s); zero where there is none.
        has_flow: where the flow is known.
    """

    pixels: Float[Tensor, "b n 2"]
    age_s: Float[Tensor, "b n"]
    polarity: Float[Tensor, "b n"]
    mask: Bool[Tensor, "b n"]
    flow: Float[Tensor, "b n 2"]
    has_flow: Bool[Tensor, "b n"]


@dataclass(frozen=True)
class Matches:
    """Contour point of each observation.

    Args:
        contour: index of the contour point; 0 where there is none.
        mask: which observations are matched.
        targets: ideal pixels of the observations, moved to the window's end.
        directions: unit directions along which the distance counts.
    """

    contour: Int[Tensor, "b n"]
    mask: Bool[Tensor, "b n"]
    targets: Float[Tensor, "b n 2"]
    directions: Float[Tensor, "b n 2"]


@dataclass(frozen=True)
class ContourIndex:
    """The nearest contour point of every pixel of a region, within a radius.

    Args:
        origin: ideal pixel (u, v) of the region's first entry.
        size: (height, width) of the region.
        nearest: contour index per pixel, -1 where none is near.
        pixels: where the contour points were when the index was made.
    """

    origin: Int[Tensor, "b 2"]
    size: tuple[int, int]
    nearest: Int[Tensor, "b p"]
    pixels: Float[Tensor, "b m 2"]

    def look_up(self, pixels: Float[Tensor, "b n 2"]) -> Int[Tensor, "b n"]:
        """Nearest contour point of each pixel, -1 where none is near."""
        height, width = self.size
        local = pixels.round() - self.origin[:, None]
        u, v = local.unbind(-1)
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        cell = torch.where(inside, v * width + u, 0).long()
        return torch.where(inside, self.nearest.gather(1, cell), -1)


def index_contours(contours: Contours, image_size: tuple[int, int], radius_px: int) -> ContourIndex:
    """Index the visible contour points by pixel; those far outside the image (height, width) are left out."""
    batch, count, _ = contours.pixels.shape
    device = contours.pixels.device
    limit = torch.tensor([image_size[1] - 1, image_size[0] - 1], device=device)
    inside = contours.mask & ((contours.pixels > -radius_px) & (contours.pixels < limit + radius_px)).all(-1)
    centre = torch.where(inside[..., None], contours.pixels, 0).round().long()
    low = torch.where(inside[..., None], centre, 2**31).amin(1).clamp(max=2**30) - radius_px
    span = (torch.where(inside[..., None], centre - low[:, None], 0).amax((0, 1)) + radius_px + 1).tolist()
    width, height = span
    step = torch.arange(-radius_px, radius_px + 1, device=device)
    disc = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1).flatten(0, 1)
    disc = disc[disc.square().sum(-1) <= radius_px**2]
    # |c + o - p|² of every point p, its central pixel c and every offset o, as one matrix product.
    to_centre = centre.to(contours.pixels.dtype) - contours.pixels
    offsets = disc.to(to_centre.dtype)
    point_part = torch.cat([to_centre.square().sum(-1, keepdim=True), torch.ones_like(to_centre[..., :1]), 2 * to_centre], -1)
    offset_part = torch.cat([torch.ones_like(offsets[:, :1]), offsets.square().sum(-1, keepdim=True), offsets], -1)
    distance_sq = (point_part @ (_DISTANCE_STEPS * offset_part.T)).clamp(min=0)
    key = distance_sq.long() * count + torch.arange(count, device=device)[:, None]
    local = centre - low[:, None]
    # Masked points write to spare entries after the last.
    first = torch.where(inside, local[..., 1] * width + local[..., 0], height * width + radius_px * (width + 1))
    cell = first[..., None] + (disc[:, 1] * width + disc[:, 0])
    nothing = torch.iinfo(torch.int64).max
    keys = torch.full((batch, height * width + 2 * radius_px * (width + 1) + 1), nothing, device=device)
    keys = keys.scatter_reduce(1, cell.flatten(1), key.flatten(1), "amin")[:, : height * width]
    return ContourIndex(low, (height, width), torch.where(keys == nothing, -1, keys % count), contours.pixels)


def pixel_velocity(
    points_cam: Float[Tensor, "b m 3"], velocity: Float[Tensor, "b 6"], centre_cam: Float[Tensor, "b 3"], intrinsics: Float[Tensor, "b 4"]
) -> Float[Tensor, "b m 2"]:
    """Image velocity (px/s) of points that turn about ``centre_cam`` and move with it: ``velocity`` is [rad/s, m/s]."""
    rotating = torch.linalg.cross(velocity[:, None, :3].expand_as(points_cam), points_cam - centre_cam[:, None], dim=-1)
    moving = rotating + velocity[:, None, 3:]
    inverse_depth = points_cam[..., 2:].clamp(min=MIN_DEPTH_M).reciprocal()
    return (moving[..., :2] - points_cam[..., :2] * inverse_depth * moving[..., 2:]) * inverse_depth * intrinsics[:, None, :2]


def object_plane_velocity(
    pixels: Float[Tensor, "b n 2"], velocity: Float[Tensor, "b 6"], centre_cam: Float[Tensor, "b 3"], intrinsics: Float[Tensor, "b 4"]
) -> Float[Tensor, "b n 2"]:
    """Image velocity (px/s) that a pixel would have at the depth of the object's centre."""
    depth = centre_cam[:, None, 2:].expand(-1, pixels.shape[1], -1)
    rays = (pixels - intrinsics[:, None, 2:]) / intrinsics[:, None, :2]
    return pixel_velocity(torch.cat([rays * depth, depth], -1), velocity, centre_cam, intrinsics)


def select_events(
    pixels: Float[Tensor, "b e 2"],
    age_s: Float[Tensor, "b e"],
    polarity: Float[Tensor, "b e"],
    mask: Bool[Tensor, "b e"],
    index: ContourIndex,
    plane_velocity: Float[Tensor, "b e 2"],
    count: int,
) -> Observations:
    """Events near an object's contours once moved to the window's end: at most ``count``, spread evenly in time."""
    near = mask & (index.look_up(pixels + plane_velocity * age_s[..., None]) >= 0)
    chosen, exists = select_ranked(near, count)
    flow = torch.zeros(*chosen.shape, 2, dtype=pixels.dtype, device=pixels.device)
    values = take_points(torch.cat([pixels, age_s[..., None], polarity[..., None]], -1), chosen)
    return Observations(values[..., :2], values[..., 2], values[..., 3], exists, flow, torch.zeros_like(exists))


def join(first: Observations, second: Observations) -> Observations:
    """Observations of both, for each object."""
    return Observations(*(torch.cat([getattr(first, name), getattr(second, name)], 1) for name in vars(first)))


@dataclass(frozen=True)
class Belief:
    """What an observation is believed to belong to, from the last round or from the object's plane.

    Args:
        velocity: image velocity (px/s) that carries the observation to the window's end.
        moved: how far its contour moved since the contours were indexed (px).
    """

    velocity: Float[Tensor, "b n 2"]
    moved: Float[Tensor, "b n 2"]


def match_nearest(
    observations: Observations,
    contours: Contours,
    index: ContourIndex,
    belief: Belief,
    contour_velocity: Float[Tensor, "b m 2"],
    gate_px: float,
    dark_shift_px: float,
) -> tuple[Matches, Belief]:
    """Match each observation with its nearest contour point, as far as the gate; distances count along the normal.

    Args:
        contours: at the current pose; ``index`` may be of an earlier one.
        belief: where to look for each observation; returned anew for the next round.
        contour_velocity: velocity of each contour point (px/s); zero to switch motion compensation off.
        dark_shift_px: how far events lie to the dark side of a sharp edge.
    """
    found = index.look_up(observations.pixels + belief.velocity * observations.age_s[..., None] - belief.moved)
    contour = found.clamp(min=0)
    # The limb of a smooth surface is no step: its shading fades towards it.
    sharp = (contours.kind != int(ContourKind.LIMB)).to(contour_velocity.dtype)
    table = torch.cat([contours.pixels, contours.normals, contour_velocity, contours.pixels - index.pixels, sharp[..., None]], -1)
    values = take_points(table, contour)
    pixels, normals, velocity, moved = values[..., :8].chunk(4, -1)
    targets = observations.pixels + velocity * observations.age_s[..., None]
    targets = targets - dark_shift_px * towards_dark(observations.polarity * values[..., 8], normals, velocity)
    near = (pixels - targets).square().sum(-1) < gate_px**2
    matched = observations.mask & (found >= 0) & near
    keep = matched[..., None]
    return Matches(contour, matched, targets, normals), Belief(torch.where(keep, velocity, belief.velocity), torch.where(keep, moved, belief.moved))


def towards_dark(polarity: Float[Tensor, "b n"], normals: Float[Tensor, "b n 2"], velocity: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
    """Unit vector across each contour to its darker side; shorter where the contour hardly moves across itself.

    A pixel gets brighter when the bright side moves over it: the dark side is then ahead. A pixel sees the logarithm of
    a blurred step, whose middle lies at ``Φ⁻¹(1 / (1 + √contrast))`` blur widths: always on the dark side.
    """
    across = (normals * velocity).sum(-1)
    return (polarity * across / (across.abs() + _SLOW_PX_S))[..., None] * normals


def match_along_flow(
    observations: Observations, contours: Contours, contour_velocity: Float[Tensor, "b m 2"], gate_px: float, config: MatchingConfig
) -> Matches:
    """Match each corner with the contour point nearest to it along the line of its flow, either way (the paper's 3.3).

    The paper moves corners along the flow "to locate the edge points"; seen from a pose that is a window old the edge
    lies behind, from a predicted one on either side, so both ways are searched. Contours that the flow hardly crosses
    are no match.
    """
    speed = observations.flow.norm(dim=-1, keepdim=True)
    heading = observations.flow / speed.clamp(min=1e-6)
    offsets = contours.pixels[:, None] - observations.pixels[:, :, None]
    along = (offsets * heading[:, :, None]).sum(-1)
    across = offsets[..., 1] * heading[..., None, 0] - offsets[..., 0] * heading[..., None, 1]
    crossing = (contours.normals[:, None] * heading[:, :, None]).sum(-1).abs()
    allowed = contours.mask[:, None] & (across.abs() < config.flow_tolerance_px) & (along.abs() < gate_px) & (crossing > _MIN_CROSSING)
    distance, contour = torch.where(allowed, along.square() + across.square(), torch.inf).min(-1)
    targets = observations.pixels + take_points(contour_velocity, contour) * observations.age_s[..., None]
    directions = heading if config.residual == "flow" else take_points(contours.normals, contour)
    return Matches(contour, observations.mask & observations.has_flow & torch.isfinite(distance), targets, directions)


def both_coordinates(matches: Matches) -> Matches:
    """The same matches with the distance in u and in v, as two observations each."""
    axes = torch.eye(2, dtype=matches.targets.dtype, device=matches.targets.device)
    directions = torch.cat([axes[axis].expand_as(matches.targets) for axis in range(2)], 1)
    contour, mask = (torch.cat([value, value], 1) for value in (matches.contour, matches.mask))
    return Matches(contour, mask, torch.cat([matches.targets, matches.targets], 1), directions)
