"""What observations that lie side by side err by in common: many of them do not tell as much more.

Two things are the same for all around: how far the model of a smooth limb is off, and which of two close edges fired.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.linalg import vecdot

from torchtrack.core.constants import constant, one
from torchtrack.core.padded import take_points
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours

# Where an edge is looked for beside another (px): found as far as twice that.
ASIDE_PX = 2.0
# Contours with normals this parallel (|n·m| above) and this far apart (px) are two edges.
PARALLEL, APART_PX = 0.9, 0.5
# So are sharp edges that hardly lie apart in the image, if they do in depth: by more than this share of the depth of all that is seen.
TOUCHING_PX, DEPTH_SHARE = 0.1, 0.2
# Events around such two edges sort themselves onto both by chance: as if these were farther apart by this much (px²).
SORTED_PX2 = 0.3


def told_by_each(beside: Float[Tensor, "b n"], common_px2: Float[Tensor, "b n"], observation_px: float) -> Float[Tensor, "b n"]:
    """What each of so many observations in one place of the image tells, of what it would tell alone.

    Side by side they err alike, so the mean of n has a variance of ``common_px2 + observation_px² / n``. Otherwise a pose would
    follow the places with the most events, and what is seen of an object that is half hidden would seem to tell all.

    Args:
        beside: how many observations are on the contour in the place of each.
        common_px2: variance of what they have in common (px²).
        observation_px: standard deviation of what each has alone.
    """
    return torch.addcmul(one(beside), beside, common_px2, value=observation_px**-2).reciprocal()


def mistaken_px2(
    contours: Contours, index: ContourIndex, of_edges: Bool[Tensor, "b m"], sharp: Bool[Tensor, "b m"], close_px: float
) -> Float[Tensor, "b m"]:
    """Mean square of how far off what is seen on each contour point is, should it be of the edge beside (px²).

    A face that comes into sight has its new edge beside the old one, and of the two often only one fires, as the other hardly
    shows. Events around it are then taken for those of the silent edge, too, which they draw to themselves: the face never opens.
    Of two edges ``s`` apart the wrong one is chosen with a probability of ``exp(-(s / close_px)²) / 2``, and that is ``s`` off.

    Where two sharp edges at different depths nearly cover each other, what is noise to one side of them is taken for the one, and
    what is noise to the other side for the other: a pose that draws them apart explains both, however silent one of them is.

    Args:
        contours: with the ``index`` of them.
        of_edges: points that are on edges of the mesh: of print, both sides fire.
        sharp: which of them are creases.
        close_px: distance from which edges are told apart.
    """
    pixels, normals = contours.pixels[:, None], contours.normals[:, None]
    aside_px = constant((-ASIDE_PX, ASIDE_PX), pixels.dtype, pixels.device)[:, None]
    found = index.look_up(torch.addcmul(pixels, normals, aside_px[..., None]).flatten(1, 2))
    counts = contours.mask & of_edges
    depth_m = contours.points_cam[..., 2]
    marks = torch.stack([counts.to(pixels.dtype), sharp.to(pixels.dtype), depth_m], -1)
    known = take_points(torch.cat([contours.pixels, contours.normals, marks], -1), found.clamp(min=0)).unflatten(1, (2, -1))
    other_pixels, other_normals, other_marks = known.split((2, 2, 3), -1)
    is_edge, is_sharp, other_depth_m = other_marks.unbind(-1)
    apart_px = vecdot(other_pixels - pixels, normals)
    is_parallel = vecdot(other_normals, normals).abs() > PARALLEL
    least_m = DEPTH_SHARE * _range_m(depth_m, contours.mask)[:, None, None]
    is_deep = ((other_depth_m - depth_m[:, None]).abs() > least_m) & sharp[:, None] & (is_sharp > 0)
    # To the side that was looked at, and not the same edge.
    beyond_px = apart_px * aside_px / ASIDE_PX
    is_apart = (beyond_px > APART_PX) | (is_deep & (beyond_px > TOUCHING_PX))
    is_other = is_apart & is_parallel & counts[:, None] & (is_edge > 0) & (found >= 0).unflatten(1, (2, -1))
    squared = apart_px.square()
    seeming = torch.where(is_deep, squared + SORTED_PX2, squared)
    return torch.where(is_other, 0.5 * seeming * torch.exp(squared * -(close_px**-2)), 0).amax(1)


def _range_m(depth_m: Float[Tensor, "b m"], mask: Bool[Tensor, "b m"]) -> Float[Tensor, "b"]:
    """How far apart in depth the nearest and the farthest point of each object are (m)."""
    return torch.where(mask, depth_m, -torch.inf).amax(1) - torch.where(mask, depth_m, torch.inf).amin(1)
