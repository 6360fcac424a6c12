"""How dense events are on outlines: :func:`torchtrack.tracking.relocalization.sampling.score_outlines`, point by point."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import entries, inverse_depth, lens, placed, turned
from torchtrack.backends.numba.parameters import ShowingSettings
from torchtrack.backends.numba.points import SHOWING, ModelPoints, normal_of
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.relocalization import sampling
from torchtrack.tracking.relocalization.event_image import BORDER_PX


class Scoring(NamedTuple):
    """How outlines are scored: where points show, how wide the border of images is (px), and how far beside a point it is less dense (px)."""

    showing: ShowingSettings
    border_px: int
    beside_px: float


@kernel(fastmath=FAST)
def score_outlines(points: ModelPoints, T_cam_obj: Array, intrinsics: Array, images: Array, scoring: Scoring, scores: Array) -> None:
    """How much denser events are on contours at some poses than beside them: :func:`torchtrack.tracking.relocalization.sampling.score_outlines`.

    Args:
        points: of each pose ``[n, 3, m]``; or one row for all of an object.
        T_cam_obj: ``[n, 4, 4]``, as many in turn of each object.
        intrinsics: ``[k, 4]``.
        images: ``[k, h, w]``, with a border.
        scores: ``[n]``, filled.
    """
    (points_obj, tangents_obj, mask), (settings, border_px, beside_px) = points, scoring
    height, width = float(images.shape[1]), float(images.shape[2])
    for n in range(len(scores)):
        k, row = n * len(images) // len(scores), n * len(mask) // len(scores)
        of_lens, flat, pose, total, count = lens(intrinsics[k]), images[k].ravel(), entries(T_cam_obj[n]), 0.0, 0
        for i in range(mask.shape[1]):
            x, y, z = placed(pose, points_obj[row, 0, i], points_obj[row, 1, i], points_obj[row, 2, i])
            inverse = inverse_depth(z)
            ax, ay, az = turned(pose, tangents_obj[row, 0, i], tangents_obj[row, 1, i], tangents_obj[row, 2, i])
            nu, nv, length = normal_of(ax - x * inverse * az, ay - y * inverse * az, inverse, of_lens)
            if mask[row, i] and length > settings.least_px_per_m and z > settings.least_depth_m:
                u, v = x * inverse * of_lens[0] + of_lens[2], y * inverse * of_lens[1] + of_lens[3]
                outer = at(flat, width, height, u + beside_px * nu, v + beside_px * nv, border_px)
                inner = at(flat, width, height, u - beside_px * nu, v - beside_px * nv, border_px)
                total += at(flat, width, height, u, v, border_px) - 0.5 * (outer + inner)
                count += 1
        scores[n] = total / max(count, 1)


@kernel(fastmath=FAST)
def at(image: Array, width: float, height: float, u: float, v: float, border_px: int) -> float:
    """What an image with its border, row by row, has at a pixel: :func:`torchtrack.tracking.relocalization.event_image.look_up`."""
    column, row = np.rint(u) + border_px, np.rint(v) + border_px
    # What is not a number is looked up at the first pixel. No branch, of which a processor would guess many wrong.
    column, row = min(column if column >= 0 else 0.0, width - 1.0), min(row if row >= 0 else 0.0, height - 1.0)
    return image[np.uint64(row * width + column)]


@accelerates(sampling.score_outlines)
def score_outlines_numba(
    outlines: Contours, T_cam_obj: Float[Tensor, "n 4 4"], intrinsics: Float[Tensor, "k 4"], images: Float[Tensor, "k h w"]
) -> Float[Tensor, "n"]:
    """Point by point."""
    scores = images.new_empty(len(T_cam_obj))
    given = as_arrays(outlines.points_obj.transpose(1, 2), outlines.tangents_obj.transpose(1, 2), outlines.mask)
    score_outlines(given, *as_arrays(T_cam_obj, intrinsics, images), (SHOWING, BORDER_PX, sampling.AROUND_PX), scores.numpy())
    return scores
