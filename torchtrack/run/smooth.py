"""The steps of a run, held back until what came after them is known, and given on with refined poses."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.camera import Camera
from torchtrack.core.lie import orthonormalise, transform_points
from torchtrack.core.pose_covariance import left_covariance
from torchtrack.object_model import ObjectModel
from torchtrack.run.stepping import Step
from torchtrack.tracking.contours.points import reproject
from torchtrack.tracking.motion.smoother import Filtered, smoothed
from torchtrack.tracking.state import TrackerState


@dataclass(frozen=True)
class SmoothedObjects:
    """What has to be known of the objects of a run: centre (m), diameter (m) and ``[fx, fy, cx, cy]`` of the camera of each."""

    centre_obj: Float[Tensor, "b 3"]
    diameter_m: Float[Tensor, "b"]
    intrinsics: Float[Tensor, "b 4"]

    @classmethod
    def from_models(cls, models: Sequence[ObjectModel], camera: Camera) -> "SmoothedObjects":
        """Objects that are seen by one camera."""
        centre_obj = torch.stack([model.centre for model in models]).double()
        diameter_m = torch.tensor([model.diameter_m for model in models], dtype=torch.float64)
        return cls(centre_obj, diameter_m, camera.intrinsics().double().expand(len(models), 4))


class Smoother:
    """Takes the steps of a run as they come, and gives each on once those of the ``smoothing.lag_s`` after it are there.

    They come in batches, so that some are smoothed by up to twice as much. In memory are the events and results of twice the
    lag; states that are given on have no maps of events, which take far more. Status and quality are as the tracker had them.
    """

    def __init__(self, objects: SmoothedObjects, config: TrackerConfig) -> None:
        self._objects, self._config = objects, config
        self._held: list[Step] = []

    def add(self, step: Step) -> list[Step]:
        """Take one step; returns those that are due, in order."""
        self._held.append(replace(step, state=step.state.without_maps()))
        lag_us = 1e6 * self._config.smoothing.lag_s
        newest_us = step.window.t_end_us
        if newest_us - self._held[0].window.t_end_us < 2 * lag_us:
            return []
        return self._given_on(sum(newest_us - held.window.t_end_us >= lag_us for held in self._held))

    def rest(self) -> list[Step]:
        """Those that are still held back, when no more come."""
        return self._given_on(len(self._held))

    def _given_on(self, count: int) -> list[Step]:
        """The first steps, smoothed by all that are held."""
        begun = time.perf_counter()
        with torch.inference_mode():
            refined = _refined(self._held, self._objects, self._config, count)
        seconds = (time.perf_counter() - begun) / max(count, 1)
        self._held = self._held[count:]
        return [replace(step, seconds=step.seconds + seconds) for step in refined]


def _refined(held: Sequence[Step], objects: SmoothedObjects, config: TrackerConfig, count: int) -> list[Step]:
    """The first ``count`` of the steps, smoothed by all of them."""
    if not count:
        return []
    after = smoothed(filtered_of([step.state for step in held]), objects.centre_obj, objects.diameter_m, config.motion)
    poses = zip(orthonormalise(after.T_cam_obj), after.velocity, after.covariance, strict=True)
    return [_with_pose(step, objects, *pose) for step, pose in zip(held[:count], poses, strict=False)]


def _with_pose(step: Step, objects: SmoothedObjects, T_cam_obj: Tensor, velocity: Tensor, covariance: Tensor) -> Step:
    """The step with other poses, velocities and covariances, all of its objects."""
    state, result = step.state, step.result
    left = left_covariance(covariance[:, :6, :6], transform_points(T_cam_obj, objects.centre_obj[:, None])[:, 0])
    T_cam_obj, velocity, covariance, left = (values.to(state.T_cam_obj.device) for values in (T_cam_obj, velocity, covariance, left))
    points = result.contours.points_cam
    contours = reproject(result.contours, T_cam_obj.to(points.dtype), objects.intrinsics.to(points))
    motion = replace(state.motion, T_cam_obj=T_cam_obj, velocity=velocity.to(state.velocity.dtype), covariance=covariance)
    state = replace(state, motion=motion)
    return replace(step, state=state, result=replace(result, T_cam_obj=T_cam_obj, covariance=left, contours=contours))


def filtered_of(states: Sequence[TrackerState]) -> Filtered:
    """What the states of one stream after consecutive windows say."""
    known = zip(*((state.T_cam_obj, state.velocity, state.motion.covariance) for state in states), strict=True)
    return Filtered(torch.cat([state.t_us for state in states]).cpu(), *(torch.stack(values).double().cpu() for values in known))
