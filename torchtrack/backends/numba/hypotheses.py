"""Where contour points have most events along their normals: :func:`torchtrack.tracking.relocalization.edge_search.strongest_along_normals`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.numba.arrays import ContourArrays, contour_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.outlines import at
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.relocalization import edge_search
from torchtrack.tracking.relocalization.event_image import BORDER_PX


class Looking(NamedTuple):
    """How far each contour point looks, at so many places, in images with a border so wide (px)."""

    reach_px: float
    looks: int
    border_px: int


@kernel(fastmath=FAST)
def look_along_normals(contours: ContourArrays, images: Array, looking: Looking, targets: Array, weights: Array) -> None:
    """The place with most events along the normal of each contour point, rather near by, and how much that counts.

    Args:
        contours: as many in turn of each image.
        images: ``[k, h, w]``, with a border.
        targets, weights: ``[n, m, 2]`` and ``[n, m]``, filled.
    """
    (_, pixels, normals, mask, _), (reach_px, looks, border_px) = contours, looking
    height, width = float(images.shape[1]), float(images.shape[2])
    step_px = np.linspace(-reach_px, reach_px, looks)
    near = 1.0 - np.abs(step_px) / (reach_px + 1.0)
    for n in range(len(mask)):
        flat = images[n * len(images) // len(mask)].ravel()
        for i in range(mask.shape[1]):
            u, v, nu, nv = pixels[n, 0, i], pixels[n, 1, i], normals[n, 0, i], normals[n, 1, i]
            most, place = 0.0, 0
            if mask[n, i]:
                for j in range(looks):
                    there = at(flat, width, height, u + step_px[j] * nu, v + step_px[j] * nv, border_px) * near[j]
                    place = j if there > most else place
                    most = max(there, most)
            targets[n, i, 0], targets[n, i, 1], weights[n, i] = u + step_px[place] * nu, v + step_px[place] * nv, most


@accelerates(edge_search.strongest_along_normals)
def strongest_along_normals_numba(
    outlines: Contours, images: Float[Tensor, "k h w"], reach_px: float
) -> tuple[Float[Tensor, "n m 2"], Float[Tensor, "n m"]]:
    """Point by point."""
    targets, weights = images.new_empty(*outlines.mask.shape, 2), images.new_empty(outlines.mask.shape)
    looking = reach_px, edge_search.LOOKS, BORDER_PX
    look_along_normals(contour_arrays(outlines), images.contiguous().numpy(), looking, targets.numpy(), weights.numpy())
    return targets, weights
