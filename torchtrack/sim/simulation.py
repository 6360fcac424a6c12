"""From a scene's settings to a sequence: frames that adapt to the motion, events, exact poses."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.io.reading import Progress
from torchtrack.io.trajectory import Trajectory
from torchtrack.sim.drawing import merge_regions
from torchtrack.sim.event_camera import EventCamera
from torchtrack.sim.frames import MAX_INTERVAL_US, frame_times
from torchtrack.sim.lens import LensRenderer
from torchtrack.sim.render import Frame, Renderer
from torchtrack.sim.scenes import Model, SceneConfig
from torchtrack.sim.surface import RenderObject
from torchtrack.sim.trajectory import truth_times, velocity
from torchtrack.sim.world import World, make_world

BACKGROUND, NOISE = -1, -2
"""Sources of events beside the objects."""

# Lens blur and the motion between frames carry an outline's events about this far from its object.
_OUTLINE_REACH_PX = 2
_NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)
# Poses per round, to bound memory.
_POSES_PER_ROUND = 2048
# Straight lines between this many frames follow a sine to a percent of its amplitude.
_FRAMES_PER_FLICKER = 24
# The light turns no further than this between two frames.
_LARGEST_LIGHT_TURN_DEG = 0.5
# The photoreceptor's answer is taken as a straight line between frames.
_PHOTORECEPTOR_INTERVAL_US = 1000.0


@dataclass(frozen=True)
class SimulatedSequence:
    """Events of a scene with all that is known about it.

    Args:
        name: of the scene.
        events: sorted by time, from 1 µs to the end of the scene.
        source: of every event: the number of an object, or of an occluder (they count on after the objects), or
            :data:`BACKGROUND` or :data:`NOISE`.
        camera: the camera.
        labels, occluder_labels: of the objects, and of what passes before them.
        models, trajectories: one per object, then one per occluder; meshes in metres with their textures, true poses at 1 kHz.
        velocities: twists ``[rotation (rad/s), translation (m/s)]`` with ``dT_cam_obj/dt = ξ^ T_cam_obj``, at the same times.
        meta: settings and facts of the simulation, as JSON can hold them.
    """

    name: str
    events: EventBatch
    source: Int[Tensor, "n"]
    camera: Camera
    labels: tuple[str, ...]
    occluder_labels: tuple[str, ...]
    models: tuple[Model, ...]
    trajectories: tuple[Trajectory, ...]
    velocities: Float[Tensor, "o p 6"]
    meta: dict[str, Any]


def render_frames(config: SceneConfig, t_us: Int[ndarray, "p"], models: Sequence[Model] | None = None, world: World | None = None) -> Iterator[Frame]:
    """The images of a scene at the given times; models (of objects, then occluders) and world are made where they are not given."""
    items = (*config.objects, *config.occluders)
    models = models or [item.build() for item in items]
    world = world or make_world(config, models)
    objects = [tuple(RenderObject.from_mesh(part, item.reflectance, item.gloss) for part in model) for model, item in zip(models, items, strict=True)]
    make = Renderer if world.camera.distortion_model == "none" else LensRenderer
    renderer = make(objects, world.camera, world.still_background(), config.render)
    for first in range(0, len(t_us), _POSES_PER_ROUND):
        t_s = torch.from_numpy(t_us[first : first + _POSES_PER_ROUND]).double() * 1e-6
        T_cam_obj, T_world_cam = world.all_poses(t_s).numpy(), world.camera_poses(t_s).numpy()
        for poses, of_camera, at in zip(T_cam_obj, T_world_cam, t_s.tolist(), strict=True):
            yield renderer.render(poses, world.scenery(of_camera, at))


def simulate(config: SceneConfig, progress: Progress | None = None) -> SimulatedSequence:
    """Simulate a scene; the same settings give the same events.

    Args:
        config: the scene.
        progress: called after every frame with the share that is done, 0 to 1.

    Raises:
        MissingExtraError: if numba is not installed.
        ConfigError: if the speed asked for cannot be reached.
        MissingFileError, UnknownFormatError, ModelError, PoseError: if there is something wrong with a file that the scene names.
    """
    items = (*config.objects, *config.occluders)
    models = tuple(item.build() for item in items)
    world = make_world(config, models)
    duration_us = max(1, round(config.duration_s * 1e6))
    t_us, worst_px = frame_times(world.way_px, duration_us, config.max_motion_px, _max_interval_us(config))
    events, source = _events(config, world, render_frames(config, t_us, models, world), t_us, progress)
    truth_us = truth_times(duration_us)
    truth_s = truth_us.double() * 1e-6
    return SimulatedSequence(
        config.name,
        events,
        source,
        world.camera,
        tuple(item.label for item in config.objects),
        tuple(item.label for item in config.occluders),
        models,
        tuple(Trajectory(truth_us, world.object_poses(number, truth_s)) for number in range(len(items))),
        torch.stack([velocity(partial(world.object_poses, number), truth_s) for number in range(len(items))]),
        _meta(config, world, len(t_us), worst_px),
    )


def _max_interval_us(config: SceneConfig) -> float:
    """Longest time between two frames, so that what changes without moving is followed too."""
    longest = float(MAX_INTERVAL_US)
    if config.light.flicker_hz and config.light.flicker_depth:
        longest = min(longest, 1e6 / (_FRAMES_PER_FLICKER * config.light.flicker_hz))
    if config.light.turn_deg_s:
        longest = min(longest, 1e6 * _LARGEST_LIGHT_TURN_DEG / abs(config.light.turn_deg_s))
    if config.event_camera_config.bandwidth_hz:
        longest = min(longest, _PHOTORECEPTOR_INTERVAL_US)
    return max(longest, 1.0)


def _events(
    config: SceneConfig, world: World, frames: Iterator[Frame], t_us: Int[ndarray, "p"], progress: Progress | None
) -> tuple[EventBatch, Int[Tensor, "n"]]:
    """Events that the frames cause, and what caused each (see :class:`SimulatedSequence`)."""
    sensor = EventCamera(config.event_camera_config, world.camera.width, world.camera.height, config.seed)
    previous = next(frames)
    state, batches, sources = sensor.start(torch.from_numpy(previous.luminance), int(t_us[0])), [], []
    for done, (frame, frame_us) in enumerate(zip(frames, t_us[1:].tolist(), strict=True), start=1):
        changed = None if world.changes_everywhere else [region.slices for region in merge_regions([*previous.regions, *frame.regions])]
        state, events, is_noise = sensor.step_with_causes(state, torch.from_numpy(frame.luminance), frame_us, changed)
        batches.append(events)
        sources.append(event_sources(events, is_noise, previous, frame))
        previous = frame
        if progress is not None:
            progress(done / (len(t_us) - 1))
    return concatenate(batches), torch.cat(sources)


def event_sources(events: EventBatch, is_noise: Bool[Tensor, "n"], before: Frame, after: Frame) -> Int[Tensor, "n"]:
    """What caused each event: who holds its pixel after it or before it or, at an outline, a pixel beside it."""
    owner = np.where(after.object_index >= 0, after.object_index, before.object_index)
    for _ in range(_OUTLINE_REACH_PX):
        # Where two meet outside of both, what passes before the objects comes first.
        owner = np.where(owner >= 0, owner, cv2.dilate(owner, _NEIGHBOURS))
    source = owner[events.y.numpy(), events.x.numpy()]
    return torch.from_numpy(np.where(is_noise.numpy(), NOISE, source).astype(np.int16))


def _meta(config: SceneConfig, world: World, frames: int, worst_px: float) -> dict[str, Any]:
    """Settings and facts, under the names that sequences of this layout use."""
    return {
        "name": config.name,
        "duration_s": config.duration_s,
        "speed": config.peak_speed or config.speed,
        "time_factor": world.speed,
        "bg": config.background.kind if config.background.image is None else "image",
        "occluder": bool(config.occluders),
        "noise": "custom" if config.event_camera else config.noise,
        "event_camera": config.event_camera_config.model_dump(),
        "seed": config.seed,
        "max_px": config.max_motion_px,
        "ss": config.render.supersampling,
        "frames": frames,
        "worst_px": worst_px,
        "labels": [item.label for item in config.objects],
        "convention": "OpenCV camera, object->camera, metres, pixel centre at integer",
        "scene": config.model_dump(mode="json"),
    }
