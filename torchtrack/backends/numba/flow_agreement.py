"""Flows beside the motion of contours, observation by observation: :func:`torchtrack.tracking.association.flow_agreement.guided_by_flow`."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.filling import filled
from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, across, at_depth, drift, inverse_depth, lens
from torchtrack.backends.numba.index import cells_of
from torchtrack.backends.numba.look_up import nearest
from torchtrack.backends.numba.parameters import AgreementSettings, Cells
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.association import flow_agreement
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.motion.prediction import Prediction

# Of a contour point: its normal, its speed across itself, and what the variance of that is.
_NORMAL_U, _NORMAL_V, _SPEED, _VARIANCE = range(4)


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
    unseen_s: Array,
    settings: AgreementSettings,
    trust: Array,
) -> None:
    """Compare the flow of each observation with the contour that is nearest to it.

    Args:
        pixels, ages_s, flows, has_flow, exists: ``[b, 2, n]``, ``[b, n]``, ``[b, n, 2]`` and ``[b, n]``, of the observations.
        points_cam, normals: ``[b, m, 3]`` and ``[b, m, 2]`` of contour points; ``nearest_of_cell [b, p]`` and ``first [b, 2]`` are their index.
        covariance: ``[b, 6, 6]`` of the velocity.
        unseen_s: ``[b]``, since each object was seen well.
        trust: ``[b, n]``, filled; 1 where there is nothing to compare.
    """
    expected, compared = np.empty((points_cam.shape[1], 4)), np.empty(pixels.shape[2], np.int64)
    for b in range(len(pixels)):
        motion, depth_m, of_lens = drift(velocity[b], centre_cam[b]), centre_cam[b, 2], lens(intrinsics[b])
        _expect(points_cam[b], normals[b], motion, covariance[b], centre_cam[b], of_lens, expected)
        own, cells_of_object, first_of_object, count, total = trust[b], nearest_of_cell[b], first[b], 0, settings.usual
        own[:] = 1.0
        for i in range(pixels.shape[2]):
            if not (exists[b, i] and has_flow[b, i]):
                continue
            u, v, age = pixels[b, 0, i], pixels[b, 1, i], ages_s[b, i]
            speed_u, speed_v = at_depth(motion, depth_m, u, v, of_lens)
            contour = nearest(cells_of_object, first_of_object, u + speed_u * age, v + speed_v * age, cells)
            if contour < 0:
                continue
            point, flow_u, flow_v = expected[contour], flows[b, i, 0], flows[b, i, 1]
            along, speed = flow_u * point[_NORMAL_U] + flow_v * point[_NORMAL_V], point[_SPEED]
            sigma = settings.sigma_share * abs(speed) + settings.sigma_px_s
            sine2 = 1.0 - along * along / max(flow_u * flow_u + flow_v * flow_v, 1e-9)
            disagreement = (along - speed) ** 2 / (sigma * sigma + point[_VARIANCE]) + sine2 / settings.sigma_sine**2
            own[i] = max(1.0 / (1.0 + disagreement), settings.least_trust)
            compared[count], count, total = i, count + 1, total + own[i]
        mean, known = total / (count + settings.usual), np.exp(-unseen_s[b] / settings.unseen_s)
        for k in range(count):
            own[compared[k]] = 1.0 - known * (1.0 - min(own[compared[k]] / mean, 1.0))


@kernel(fastmath=FAST)
def _expect(points_cam: Array, normals: Array, motion: Numbers, covariance: Array, centre_cam: Array, of_lens: Numbers, expected: Array) -> None:
    """Fill ``expected [m, 4]`` with what is known of how contour points move across themselves."""
    gradient = np.empty(6)
    for m in range(len(expected)):
        x, y, z, nu, nv = points_cam[m, 0], points_cam[m, 1], points_cam[m, 2], normals[m, 0], normals[m, 1]
        inverse = inverse_depth(z)
        speed_u, speed_v = across(motion, x, y, z, inverse, of_lens)
        gx, gy = nu * of_lens[0] * inverse, nv * of_lens[1] * inverse
        gz = -(gx * x + gy * y) * inverse
        ax, ay, az = x - centre_cam[0], y - centre_cam[1], z - centre_cam[2]
        gradient[0], gradient[1], gradient[2] = ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx
        gradient[3], gradient[4], gradient[5] = gx, gy, gz
        variance = 0.0
        for k in range(6):
            for n in range(6):
                variance += gradient[k] * covariance[k, n] * gradient[n]
        expected[m, _NORMAL_U], expected[m, _NORMAL_V] = nu, nv
        expected[m, _SPEED], expected[m, _VARIANCE] = nu * speed_u + nv * speed_v, variance


@accelerates(flow_agreement.guided_by_flow)
def guided_by_flow_numba(
    observations: Observations, index: ContourIndex, contours: Contours, prediction: Prediction, time_since_validated_s: Float[Tensor, "b"]
) -> Observations:
    """Observation by observation."""
    trust, moving = torch.empty_like(observations.age_s), prediction.moving(compensated=True)
    agree(
        *as_arrays(observations.pixels.transpose(1, 2), observations.age_s, observations.flow, observations.has_flow, observations.mask),
        *as_arrays(contours.points_cam, contours.normals, index.nearest, index.first),
        cells_of(index),
        *as_arrays(moving.velocity, prediction.covariance[:, 6:, 6:], moving.centre_cam, moving.intrinsics, time_since_validated_s),
        filled(AgreementSettings, flow_agreement),
        trust.numpy(),
    )
    return replace(observations, trust=trust if observations.trust is None else trust * observations.trust)
