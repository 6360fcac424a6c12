"""Flows beside the motion of contours, observation by observation: :func:`torchtrack.tracking.association.flow_agreement.flow_disagreement`."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import across, at_depth, drift, inverse_depth, lens
from torchtrack.backends.numba.index import cells_of
from torchtrack.backends.numba.look_up import nearest
from torchtrack.backends.numba.parameters import AgreementSettings, Cells, filled
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.association import flow_agreement
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.motion.prediction import Prediction


@kernel(fastmath=FAST)
def agree(
    pixels: Array,
    ages_s: Array,
    flows: Array,
    has_flow: Array,
    exists: Array,
    points_cam: Array,
    normals: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    velocity: Array,
    covariance: Array,
    centre_cam: Array,
    intrinsics: Array,
    settings: AgreementSettings,
    disagreement: Array,
    is_known: Array,
) -> None:
    """Compare the flow of each observation with the contour that is nearest to it.

    Args:
        pixels, ages_s, flows, has_flow, exists: ``[b, n, 2]`` or ``[b, n]``, of the observations.
        points_cam, normals: ``[b, m, 3]`` and ``[b, m, 2]`` of contour points; ``nearest_of_cell [b, p]`` and ``first [b, 2]`` are their index.
        covariance: ``[b, 6, 6]`` of the velocity.
        disagreement, is_known: ``[b, n]``, zero so far; filled.
    """
    gradient = np.empty(6)
    for b in range(len(pixels)):
        motion, depth_m, of_lens = drift(velocity[b], centre_cam[b]), centre_cam[b, 2], lens(intrinsics[b])
        cells_of_object, first_of_object, points, lines = nearest_of_cell[b], first[b], points_cam[b], normals[b]
        for i in range(pixels.shape[1]):
            if not (exists[b, i] and has_flow[b, i]):
                continue
            u, v, age = pixels[b, i, 0], pixels[b, i, 1], ages_s[b, i]
            speed_u, speed_v = at_depth(motion, depth_m, u, v, of_lens)
            contour = nearest(cells_of_object, first_of_object, u + speed_u * age, v + speed_v * age, cells)
            if contour < 0:
                continue
            x, y, z, nu, nv = points[contour, 0], points[contour, 1], points[contour, 2], lines[contour, 0], lines[contour, 1]
            inverse = inverse_depth(z)
            speed_u, speed_v = across(motion, x, y, z, inverse, of_lens)
            gx, gy = nu * of_lens[0] * inverse, nv * of_lens[1] * inverse
            gz = -(gx * x + gy * y) * inverse
            ax, ay, az = x - centre_cam[b, 0], y - centre_cam[b, 1], z - centre_cam[b, 2]
            gradient[0], gradient[1], gradient[2] = ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx
            gradient[3], gradient[4], gradient[5] = gx, gy, gz
            variance = 0.0
            for k in range(6):
                for m in range(6):
                    variance += gradient[k] * covariance[b, k, m] * gradient[m]
            flow_u, flow_v, expected = flows[b, i, 0], flows[b, i, 1], nu * speed_u + nv * speed_v
            along = flow_u * nu + flow_v * nv
            sigma = settings.sigma_share * abs(expected) + settings.sigma_px_s
            sine2 = 1.0 - along * along / max(flow_u * flow_u + flow_v * flow_v, 1e-9)
            disagreement[b, i] = (along - expected) ** 2 / (sigma * sigma + variance) + sine2 / settings.sigma_sine**2
            is_known[b, i] = True


@accelerates(flow_agreement.flow_disagreement)
def flow_disagreement_numba(
    observations: Observations, index: ContourIndex, contours: Contours, prediction: Prediction
) -> tuple[Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """Observation by observation."""
    disagreement, is_known = torch.zeros_like(observations.age_s), torch.zeros_like(observations.mask)
    moving = prediction.moving(compensated=True)
    agree(
        *as_arrays(observations.pixels, observations.age_s, observations.flow, observations.has_flow, observations.mask),
        *as_arrays(contours.points_cam, contours.normals, index.nearest, index.first),
        cells_of(index),
        *as_arrays(moving.velocity, prediction.covariance[:, 6:, 6:], moving.centre_cam, moving.intrinsics),
        filled(AgreementSettings, flow_agreement),
        *as_arrays(disagreement, is_known),
    )
    return disagreement, is_known
