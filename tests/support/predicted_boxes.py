"""Shared by several tests: boxes."""

import torch
from helpers import SMALL_CAMERA, box_model

from torchtrack.config.tracker import ContourConfig
from torchtrack.object_model.contour_source import group_by_model
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.motion.prediction import Prediction

CONTOURS = ContourConfig()


CENTRE_OBJ = torch.tensor([0.01, -0.02, 0.005], dtype=torch.float64)


def boxes(poses, covariance=None, velocity=None, dtype=torch.float64):
    """A prediction of boxes, each in a stream of its own."""
    count = len(poses)
    objects = ObjectBatch(
        models=[group.to(dtype) for group in group_by_model([box_model()] * count, CONTOURS)],
        intrinsics=SMALL_CAMERA.intrinsics(dtype).expand(count, 4),
        centre_obj=CENTRE_OBJ.to(dtype).expand(count, 3),
        half_extent=torch.full((count, 3), 0.05, dtype=dtype),
        diameter_m=torch.full((count,), 0.17, dtype=dtype),
        stream_index=torch.arange(count),
        image_sizes=torch.tensor([[SMALL_CAMERA.height, SMALL_CAMERA.width]]).expand(count, 2),
        image_shape=(count, SMALL_CAMERA.height, SMALL_CAMERA.width),
        shared=False,
    )
    covariance = torch.zeros(count, 12, 12, dtype=torch.float64) if covariance is None else covariance
    velocity = torch.zeros(count, 6, dtype=dtype) if velocity is None else velocity.to(dtype)
    return Prediction(objects, poses.to(dtype), torch.ones(count, dtype=torch.bool), velocity, covariance)
