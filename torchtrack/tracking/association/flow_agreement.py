"""Flow as a guide: how far to trust an observation, by how the events around it move.

In: observations with their normal flow (:mod:`torchtrack.tracking.frontend.arrival_flow`), contours and predicted motion. Out: the
observations with a trust.

Of its contour, a flow ``f`` tells two things: how it lies (``f`` is along its normal ``n``), and how fast it moves across itself, which
the predicted motion ``v`` says too. In standard deviations, they disagree by ``d² = (f·n - v·n)² / σ² + sin²(f, n) / σ_sin²``; the less
the motion is known, the larger is ``σ``. The trust in an observation is ``1 / (1 + d²)``, its likelihood with long tails, over the mean
of all observations of the object: where all disagree, it is the motion that was predicted wrong.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.linalg import vecdot

from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.dispatch import accelerable
from torchtrack.core.image_velocity import pose_jacobian
from torchtrack.core.padded import take_points
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.motion.prediction import Prediction

# Standard deviation of a normal flow: a share of its speed, and so much beside it (px/s). A share of 0.25, with a sine of 0.25, lost objects
# that come out of hiding: at that moment their motion is predicted worst.
SIGMA_SHARE, SIGMA_PX_S = 0.35, 30.0
# Standard deviation of the sine of the angle between a flow and its contour's normal.
SIGMA_SINE = 0.5
# What an observation counts at least whose flow disagrees.
LEAST_TRUST = 0.05
# Observations that agree in full are counted so often beside those of an object, in the mean of their trust.
USUAL = 5.0
# Flows are asked less of an object that was not seen well lately, with this time constant (s): its motion is not known.
UNSEEN_S = 0.01


@accelerable
def guided_by_flow(
    observations: Observations, index: ContourIndex, contours: Contours, prediction: Prediction, time_since_validated_s: Float[Tensor, "b"]
) -> Observations:
    """The observations with the trust that their flow gives, beside that which they have."""
    disagreement, counts = flow_disagreement(observations, index, contours, prediction)
    trust = _normalised(1 / (1 + disagreement), counts.to(disagreement.dtype))
    known = torch.exp(time_since_validated_s / -UNSEEN_S)[:, None].to(trust.dtype)
    trust = torch.where(counts, 1 - known * (1 - trust), 1)
    return replace(observations, trust=trust if observations.trust is None else trust * observations.trust)


def flow_disagreement(
    observations: Observations, index: ContourIndex, contours: Contours, prediction: Prediction
) -> tuple[Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """How far the flow of each observation is from what the nearest contour's motion says, squared, in standard deviations.

    Returns:
        The disagreement, zero where there is none to tell, and where there is one.
    """
    flow = observations.flow
    table = torch.cat([contours.normals, prediction.contour_velocity(contours), _speed_variance(contours, prediction)[..., None]], -1)
    nearest = index.look_up(prediction.carried(observations.pixels, observations.age_s))
    normals, velocity, variance = take_points(table, nearest.clamp(min=0)).split((2, 2, 1), -1)
    across, expected = vecdot(flow, normals), vecdot(velocity, normals)
    sigma = SIGMA_SHARE * expected.abs() + SIGMA_PX_S
    sine2 = 1 - across.square() / vecdot(flow, flow).clamp(min=1e-9)
    disagreement = (across - expected).square() / (sigma.square() + variance[..., 0]) + sine2 / SIGMA_SINE**2
    counts = observations.has_flow & observations.mask & (nearest >= 0)
    return torch.where(counts, disagreement, 0), counts


def _normalised(trust: Float[Tensor, "b n"], counts: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
    """Trust over its mean of those that count."""
    trust = trust.clamp(min=LEAST_TRUST)
    mean = ((trust * counts).sum(-1, keepdim=True) + USUAL) / (counts.sum(-1, keepdim=True) + USUAL)
    return (trust / mean).clamp(max=1)


def _speed_variance(contours: Contours, prediction: Prediction) -> Float[Tensor, "b m"]:
    """Variance of the speed of contour points across themselves (px²/s²), by what is known of the object's velocity."""
    points, normals = contours.points_cam, contours.normals
    inverse_depth = points[..., 2].clamp(min=MIN_DEPTH_M).reciprocal()
    slope = normals * prediction.objects.intrinsics[:, None, :2] * inverse_depth[..., None]
    along = -(slope * points[..., :2]).sum(-1) * inverse_depth
    jacobian = pose_jacobian((points - prediction.centre_cam[:, None]).transpose(1, 2), (*slope.unbind(-1), along))
    return (jacobian * (prediction.covariance[:, 6:, 6:].to(jacobian.dtype) @ jacobian)).sum(1)
