"""Association of corners with contours along their flow, as the paper does."""

import torch

from torchtrack.core.image_velocity import MovingObjects
from torchtrack.core.padded import take_points
from torchtrack.tracking.association.matches import MatchesWithCues
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.points import Contours

# An edge this parallel to the flow (|n·f| below) is not crossed by it.
_MIN_CROSSING = 0.3
# How far beside the line of its flow a corner's contour may lie (px). Set with the first corners, and not measured alone.
_TOLERANCE_PX = 2.0


def match_along_flow(observations: Observations, contours: Contours, objects: MovingObjects, gate_px: float) -> MatchesWithCues:
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
    allowed = contours.mask[:, None] & (across.abs() < _TOLERANCE_PX) & (along.abs() < gate_px) & (crossing > _MIN_CROSSING)
    distance, contour = torch.where(allowed, along.square() + across.square(), torch.inf).min(-1)
    points_obj = take_points(contours.points_obj, contour)
    targets = torch.addcmul(observations.pixels, objects.show(points_obj)[1], observations.age_s[..., None])
    directions = take_points(contours.normals, contour)
    mask = observations.mask & observations.has_flow & torch.isfinite(distance)
    offsets = torch.where(mask, ((take_points(contours.pixels, contour) - targets) * take_points(contours.normals, contour)).sum(-1), 0)
    all_of_it = torch.ones_like(offsets)
    geometry = observations.age_s, points_obj, targets, directions, offsets, mask
    return MatchesWithCues(contour, mask, all_of_it, *geometry, all_of_it, dark=torch.zeros_like(offsets), effective=all_of_it)
