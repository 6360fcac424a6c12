"""Which observations are of the object's contour: what a weighting network is to learn, from the true pose."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.padded import take_points
from torchtrack.tracking.association.weighting_features import WeightingInputs
from torchtrack.tracking.estimation.rounds import index_for
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.tracker import Tracker


def true_distance(
    tracker: Tracker, inputs: WeightingInputs, T_cam_obj: Float[Tensor, "b 4 4"], velocity: Float[Tensor, "b 6"]
) -> Float[Tensor, "b n"]:
    """How far each observation lies from the true contour once both are at the window's end (px); infinite where none is near.

    Args:
        tracker: that made the inputs.
        inputs: of a window.
        T_cam_obj: true poses at its end.
        velocity: true rotation of each object and velocity of its centre there (rad/s, m/s), as in the tracker's state.
    """
    observations, predicted = inputs.observations, inputs.prediction
    dtype = predicted.velocity.dtype
    truth = Prediction(predicted.objects, T_cam_obj.to(dtype), predicted.usable, velocity.to(dtype), predicted.covariance)
    contours = predicted.objects.contours(truth.T_cam_obj, tracker.config.contours)
    index = index_for(contours, predicted.objects.image_size, tracker.config, torch.ones_like(truth.velocity[:, 0]))
    moved = truth.carried(observations.pixels, observations.age_s)
    nearest = index.look_up(moved)
    table = torch.cat([contours.pixels, contours.normals, truth.contour_velocity(contours)], -1)
    pixels, normals, speed = take_points(table, nearest.clamp(min=0)).chunk(3, -1)
    distance = ((torch.addcmul(observations.pixels, speed, observations.age_s[..., None]) - pixels) * normals).sum(-1).abs()
    return torch.where((nearest >= 0) & observations.mask, distance, torch.inf)
