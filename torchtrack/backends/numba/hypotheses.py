"""Where contour points have most events along their normals: :func:`torchtrack.tracking.relocalization.edge_search.strongest_along_normals`."""

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.outlines import at
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.relocalization import edge_search
from torchtrack.tracking.relocalization.event_image import BORDER_PX


@kernel(fastmath=FAST)
def look_along_normals(
    pixels: Array, normals: Array, mask: Array, images: Array, border_px: int, reach_px: float, looks: int, targets: Array, weights: Array
) -> None:
    """The place with most events along the normal of each contour point, rather near by, and how much that counts.

    Args:
        pixels, normals, mask: ``[n, 2, m]`` and ``[n, m]``, as many in turn of each image.
        images: ``[k, h, w]``, with a border of ``border_px``.
        reach_px: how far each looks, at so many ``looks``.
        targets, weights: ``[n, m, 2]`` and ``[n, m]``, filled.
    """
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
    points = as_arrays(outlines.pixels.transpose(1, 2), outlines.normals.transpose(1, 2), outlines.mask)
    look_along_normals(*points, *as_arrays(images), BORDER_PX, reach_px, edge_search.LOOKS, *as_arrays(targets, weights))
    return targets, weights
