"""Flows beside the motion of contours, observation by observation: :func:`torchtrack.tracking.association.flow_agreement.guided_by_flow`."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.filling import filled
from torchtrack.backends.numba.arrays import MovingContours, as_arrays, contour_arrays, index_arrays, moving_arrays, moving_contours
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Plane, across, carried, inverse_depth, plane_of, slope_of
from torchtrack.backends.numba.look_up import index_of, nearest
from torchtrack.backends.numba.parameters import AgreementSettings
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.association import flow_agreement
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.motion.prediction import Prediction

# Of a contour point: its normal, its speed across itself, and what the variance of that is.
_NORMAL_U, _NORMAL_V, _SPEED, _VARIANCE = range(4)


class Flows(NamedTuple):
    """Observations with their flow: ``[b, 2, n]``, ``[b, n]``, ``[b, n, 2]``, and ``[b, n]``."""

    pixels: Array
    age_s: Array
    flow: Array
    has_flow: Array
    exists: Array


class Certainty(NamedTuple):
    """How well it is known how objects move: ``[b, 6, 6]`` of the velocity, and how long ago each was seen well, ``[b]``."""

    covariance: Array
    unseen_s: Array


@kernel(fastmath=FAST)
def agree(observed: Flows, contours: MovingContours, certainty: Certainty, settings: AgreementSettings, trust: Array) -> None:
    """Compare the flow of each observation with the contour that is nearest to it.

    Args:
        trust: ``[b, n]``, filled; 1 where there is nothing to compare.
    """
    (pixels, ages_s, flows, has_flow, exists), (covariance, unseen_s), contours = observed, certainty, moving_contours(contours)
    expected, compared = np.empty((contours.shown.mask.shape[1], 4)), np.empty(pixels.shape[2], np.int64)
    for b in range(len(pixels)):
        plane, index = plane_of(contours.moving, b), index_of(contours.nearest, b)
        _expect(contours.shown.points_cam[b], contours.shown.normals[b], plane, contours.moving.centre_cam[b], covariance[b], expected)
        own, count, total = trust[b], 0, settings.usual
        own[:] = 1.0
        for i in range(pixels.shape[2]):
            if not (exists[b, i] and has_flow[b, i]):
                continue
            at_u, at_v = carried(plane, pixels[b, 0, i], pixels[b, 1, i], ages_s[b, i])
            contour = nearest(index, at_u, at_v)
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
def _expect(points_cam: Array, normals: Array, plane: Plane, centre_cam: Array, covariance: Array, expected: Array) -> None:
    """Fill ``expected [m, 4]`` with what is known of how contour points move across themselves."""
    for m in range(len(expected)):
        x, y, z, nu, nv = points_cam[0, m], points_cam[1, m], points_cam[2, m], normals[0, m], normals[1, m]
        speed_u, speed_v = across(plane.motion, x, y, z, inverse_depth(z), plane.lens)
        gradient, variance = slope_of((x, y, z), (nu, nv), centre_cam, plane.lens), 0.0
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
    trust, o = torch.empty_like(observations.age_s), observations
    agree(
        as_arrays(o.pixels.transpose(1, 2), o.age_s, o.flow, o.has_flow, o.mask),
        (contour_arrays(contours), index_arrays(index), moving_arrays(prediction.moving(compensated=True))),
        as_arrays(prediction.covariance[:, 6:, 6:], time_since_validated_s),
        filled(AgreementSettings, flow_agreement),
        trust.numpy(),
    )
    return replace(observations, trust=trust if observations.trust is None else trust * observations.trust)
