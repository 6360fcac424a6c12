"""Results as the BOP challenge takes them: a CSV of poses in images, in millimetres.

``scene_id,im_id,obj_id,score,R,t,time``: R row by row, t in mm, time in seconds (-1: not known).
"""

import csv
import os
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.atomic import atomic_path
from torchtrack.core.pose_checks import check_pose
from torchtrack.errors import PoseError
from torchtrack.io import Trajectory

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")


@dataclass(frozen=True)
class BopEstimate:
    """The pose of one object in one image.

    Args:
        scene_id, im_id, obj_id: numbers of the dataset.
        T_cam_obj: ``[4, 4]``, metres.
        score: how sure it is, the more the higher.
        time_s: what all of the image took; -1 where it is not known.

    Raises:
        PoseError: if it is no rigid motion, or a number is negative.
    """

    scene_id: int
    im_id: int
    obj_id: int
    T_cam_obj: Float[Tensor, "4 4"]
    score: float = 1.0
    time_s: float = -1.0

    def __post_init__(self) -> None:
        check_pose(self.T_cam_obj)
        if min(self.scene_id, self.im_id, self.obj_id) < 0:
            raise PoseError(f"numbers of BOP are not negative, got scene {self.scene_id}, image {self.im_id} and object {self.obj_id}.")


def estimates_at_images(trajectory: Trajectory, scene_id: int, obj_id: int, frame_us: int, first_image: int = 0) -> list[BopEstimate]:
    """The poses of one object at the times of the images that the trajectory covers, interpolated between windows.

    Args:
        trajectory: of a run, ``T_cam_obj`` over time.
        scene_id, obj_id: numbers of the dataset.
        frame_us: time from one image to the next (µs).
        first_image: number of the image at time 0.

    Raises:
        PoseError: if no image is covered, or images do not follow one another.
    """
    if frame_us < 1:
        raise PoseError(f"frame_us is the time from one image to the next (µs), got {frame_us}.")
    first, last = int(trajectory.t_us[0]), int(trajectory.t_us[-1])
    t_us = frame_us * torch.arange(-(-first // frame_us), last // frame_us + 1)
    t_us = t_us[trajectory.covers(t_us)]
    images = t_us // frame_us + first_image
    if len(images) == 0 or int(images[0]) < 0:
        raise PoseError(
            f"the poses from {first} to {last} µs cover no image of a number from 0 on, one each {frame_us} µs with image {first_image} at time 0. "
            "Correct frame_us, first_image, or the times of the poses."
        )
    return [BopEstimate(scene_id, image, obj_id, T) for image, T in zip(images.tolist(), trajectory.at(t_us), strict=True)]


def write_bop_results(path: str | os.PathLike[str], estimates: Iterable[BopEstimate]) -> None:
    """Write estimates, in the order of scenes, images and objects. BOP wants the name ``METHOD_DATASET-test.csv``.

    Raises:
        OutputError: if the file cannot be written.
    """
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS)
        for estimate in sorted(estimates, key=lambda each: (each.scene_id, each.im_id, each.obj_id)):
            T = estimate.T_cam_obj.double()
            numbers = (_joined(T[:3, :3].flatten()), _joined(1e3 * T[:3, 3]), f"{estimate.time_s:.6g}")
            rows.writerow((estimate.scene_id, estimate.im_id, estimate.obj_id, f"{estimate.score:.6g}", *numbers))


def _joined(values: Tensor) -> str:
    return " ".join(f"{value:.9g}" for value in values.tolist())
