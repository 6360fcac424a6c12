"""A scene over time: where everything is, how fast it moves in the image, and what the light does."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import QhullError
from torch import Tensor

from torchtrack.core import lie
from torchtrack.core.camera import MIN_DEPTH_M, Camera, project
from torchtrack.errors import ConfigError
from torchtrack.sim.lens import ideal_camera
from torchtrack.sim.render import Scenery
from torchtrack.sim.scenes import Model, ObjectConfig, SceneConfig
from torchtrack.sim.trajectory import AttachedMotion, Motion, make_motion

# Speeds are looked up this often in a scene when the largest one is sought.
_SPEED_SAMPLES = 1000
# A motion is not sped up by more than this to reach the speed asked for.
_MOST_SPEED_UP = 32
# As many directions are looked into for the points of a mesh that lie furthest out.
_MOST_POINTS = 200


class World:
    """Everything of a scene that moves.

    Args:
        config: the scene.
        points: of every object, then every occluder: points that none of its others outruns in the image, m.

    Raises:
        ConfigError: if the speed asked for cannot be reached.
        MissingFileError, UnknownFormatError, PoseError: if there is something wrong with a file that the scene names.
    """

    def __init__(self, config: SceneConfig, points: Sequence[Float[Tensor, "_ 3"]]) -> None:
        self.config, self.points, self.camera = config, points, config.camera.build()
        self.ideal = ideal_camera(self.camera)
        self.backdrop = config.background.build(self.ideal)
        self.background_moves = config.background.moves(config.camera_motion is not None)
        self._move(config.speed)
        if config.peak_speed_px_s is not None:
            self.speed = self._speed_for(config.peak_speed_px_s)
            self._move(self.speed)

    def _move(self, speed: float) -> None:
        """Make all motions anew, objects and camera at ``speed``."""
        config, self.speed = self.config, speed
        seed = 1000 * config.seed
        own = [make_motion(item.motion, speed, seed + i) for i, item in enumerate(config.objects)]
        by_label: dict[str | None, Motion] = {item.label: motion for item, motion in zip(config.objects, own, strict=True)}
        self.objects = [_carried(motion, by_label.get(item.attached_to)) for item, motion in zip(config.objects, own, strict=True)]
        # What hides the objects keeps its own pace.
        self.occluders = [
            _carried(make_motion(item.motion, config.speed, seed + 500 + i), by_label.get(item.attached_to))
            for i, item in enumerate(config.occluders)
        ]
        self._camera_motion = make_motion(config.camera_motion, speed, seed + 900) if config.camera_motion else None

    @property
    def changes_everywhere(self) -> bool:
        """Whether light changes outside of the objects too."""
        return self.background_moves or bool(self.config.light.flicker_hz and self.config.light.flicker_depth)

    def camera_poses(self, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q 4 4"]:
        """Poses ``T_world_cam`` of the camera."""
        if self._camera_motion is None:
            return torch.eye(4, dtype=torch.float64).repeat(len(t_s), 1, 1)
        return self._camera_motion.pose(t_s)

    def object_poses(self, number: int, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q 4 4"]:
        """Poses ``T_cam_obj`` of an object, or of an occluder: these count on after the objects."""
        T_world_obj = (self.objects + self.occluders)[number].pose(t_s)
        return T_world_obj if self._camera_motion is None else lie.se3_inverse(self.camera_poses(t_s)) @ T_world_obj

    def all_poses(self, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q o 4 4"]:
        """Poses ``T_cam_obj`` of all objects and occluders."""
        return torch.stack([self.object_poses(number, t_s) for number in range(len(self.points))], 1)

    def scenery(self, T_world_cam: Float[ndarray, "4 4"], t_s: float) -> Scenery:
        """Background and light at one time."""
        light, background = self.config.light, None
        if self.background_moves:
            background = self.backdrop.luminance(T_world_cam, t_s)
        direction = np.array(self.config.render.light_direction)
        if light.turn_deg_s:
            axis = torch.tensor(light.turn_axis, dtype=torch.float64)
            turn = lie.so3_exp(axis / axis.norm().clamp(min=1e-12) * math.radians(light.turn_deg_s) * t_s)
            direction = turn.numpy() @ direction
        u, v, w = (T_world_cam[:3, :3].T @ direction).tolist()
        brightness = 1 + light.flicker_depth * math.sin(2 * math.pi * light.flicker_hz * t_s)
        return Scenery(background, (u, v, w), brightness)

    def still_background(self) -> Float[ndarray, "h w"]:
        """The background at the start."""
        start = torch.zeros(1, dtype=torch.float64)
        return self.backdrop.luminance(self.camera_poses(start)[0].numpy(), 0.0)

    def way_px(self, t_s: Float[Tensor, "q"]) -> Float[ndarray, "q-1"]:
        """Furthest way of any point between each two neighbouring times; points at or behind the camera do not count."""
        longest = np.zeros(len(t_s) - 1)
        for number in range(len(self.points)):
            np.maximum(longest, self.object_way_px(number, t_s), out=longest)
        if self.background_moves:
            np.maximum(longest, self.backdrop.way_px(self.camera_poses(t_s).numpy(), t_s.numpy()), out=longest)
        return longest

    def object_way_px(self, number: int, t_s: Float[Tensor, "q"]) -> Float[ndarray, "q-1"]:
        """:meth:`way_px` of one object alone."""
        return longest_way(self.object_poses(number, t_s), self.points[number], self.ideal).numpy()

    def _speed_for(self, target_px_s: float) -> float:
        """The factor of time at which the fastest point of all objects has the speed asked for.

        Motions are the same in shape at any factor ``s``: what happens up to ``s`` times the duration falls into the scene,
        ``s`` times as fast.
        """
        self._move(1.0)
        step_s = self.config.duration_s / _SPEED_SAMPLES
        start, so_far = 0, 0.0
        while start < _MOST_SPEED_UP * _SPEED_SAMPLES:
            sample = torch.arange(start, start + _SPEED_SAMPLES + 1, dtype=torch.float64)
            ways = [self.object_way_px(number, sample * step_s) for number in range(len(self.objects))]
            fastest = np.maximum.accumulate(np.maximum(np.max(ways, axis=0) / step_s, so_far))
            factor = sample[1:].numpy() / _SPEED_SAMPLES
            reached = np.flatnonzero(factor * fastest >= target_px_s)
            if len(reached):
                first = int(reached[0])
                return float(np.clip(target_px_s / fastest[first], factor[first] - 1 / _SPEED_SAMPLES, factor[first]))
            start, so_far = start + _SPEED_SAMPLES, float(fastest[-1])
        raise ConfigError(
            f"peak_speed: no point of the objects of '{self.config.name}' can be brought to {target_px_s:g} px/s: at {_MOST_SPEED_UP} times "
            f"their pace they reach {_MOST_SPEED_UP * so_far:.3g} px/s. Change their motions."
        )


def _carried(motion: Motion, carrier: Motion | None) -> Motion:
    """The motion in the world of what is attached to something; of what is not, its own."""
    return motion if carrier is None else AttachedMotion(carrier, motion)


def longest_way(T_cam_obj: Float[Tensor, "p 4 4"], points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "q"]:
    """Furthest way of any point in the image between each two neighbouring poses, px."""
    points_cam = lie.transform_points(T_cam_obj, points.expand(len(T_cam_obj), -1, -1))
    pixels = project(points_cam, camera.intrinsics(torch.float64).expand(len(T_cam_obj), -1))
    in_front = points_cam[..., 2] > MIN_DEPTH_M
    way = (pixels[1:] - pixels[:-1]).norm(dim=-1)
    return torch.where(in_front[1:] & in_front[:-1], way, 0.0).amax(-1)


def outer_points(mesh: trimesh.Trimesh) -> Float[Tensor, "n 3"]:
    """Vertices of the convex hull: seen by a camera, no other vertex moves much faster than all of them.

    Of a smooth hull, those that lie furthest out in some direction.
    """
    try:
        hull = np.array(mesh.convex_hull.vertices, dtype=np.float64)
    except QhullError:  # all in one plane
        hull = np.array(mesh.vertices, dtype=np.float64)
    if len(hull) > _MOST_POINTS:
        height, turn = np.linspace(-1, 1, _MOST_POINTS), np.pi * (1 + np.sqrt(5)) * np.arange(_MOST_POINTS)
        level = np.sqrt(1 - height**2)
        directions = np.stack([level * np.cos(turn), level * np.sin(turn), height])
        hull = hull[np.unique((hull @ directions).argmax(0))]
    return torch.from_numpy(hull)


def make_world(config: SceneConfig, models: Sequence[Model] | None = None) -> World:
    """The world of a scene; its models are made where they are not given."""
    items: tuple[ObjectConfig, ...] = (*config.objects, *config.occluders)
    models = models or [item.build() for item in items]
    return World(config, [torch.cat([outer_points(part) for part in model]) for model in models])
