"""From a scene's settings to a sequence: frames that adapt to the motion, events, exact poses."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Int
from numpy import ndarray

from torchtrack.camera import Camera
from torchtrack.events import EventBatch, concatenate
from torchtrack.io.sequence import write_sequence
from torchtrack.io.trajectory import Trajectory
from torchtrack.sim.event_camera import EventCamera
from torchtrack.sim.frames import frame_times, outer_points
from torchtrack.sim.meshes import make_mesh
from torchtrack.sim.render import Frame, Renderer, merge_regions
from torchtrack.sim.scenes import SceneConfig
from torchtrack.sim.surface import RenderObject
from torchtrack.sim.trajectory import SinusoidMotion, ground_truth

Progress = Callable[[float], None]


@dataclass(frozen=True)
class SimulatedSequence:
    """Events of a scene with all that is known about it.

    Args:
        name: of the scene.
        events: sorted by time, from 1 µs to the end of the scene.
        camera: the camera.
        labels, meshes, trajectories: one per object; meshes in metres with their textures, true poses at 1 kHz.
        meta: settings and facts of the simulation, as JSON can hold them.
    """

    name: str
    events: EventBatch
    camera: Camera
    labels: tuple[str, ...]
    meshes: tuple[trimesh.Trimesh, ...]
    trajectories: tuple[Trajectory, ...]
    meta: dict[str, Any]


def motions_of(config: SceneConfig) -> list[SinusoidMotion]:
    """The motion of every object."""
    return [SinusoidMotion.from_config(item.motion, config.speed, seed=1000 * config.seed + i) for i, item in enumerate(config.objects)]


def render_frames(config: SceneConfig, t_us: Int[ndarray, "p"], meshes: Sequence[trimesh.Trimesh] | None = None) -> Iterator[Frame]:
    """The images of a scene at the given times."""
    camera = config.camera.build()
    meshes = meshes or [make_mesh(item.shape, item.scale) for item in config.objects]
    objects = [RenderObject.from_mesh(mesh, item.reflectance, item.gloss) for mesh, item in zip(meshes, config.objects, strict=True)]
    renderer = Renderer(objects, camera, config.background.build(camera.width, camera.height), config.render)
    t_s = torch.from_numpy(t_us).double() * 1e-6
    poses = torch.stack([motion.pose(t_s) for motion in motions_of(config)], 1).numpy()
    for T_cam_obj in poses:
        yield renderer.render(T_cam_obj)


def simulate(config: SceneConfig, progress: Progress | None = None) -> SimulatedSequence:
    """Simulate a scene; the same settings give the same events.

    Args:
        config: the scene.
        progress: called after every frame with the share that is done, 0 to 1.

    Raises:
        MissingExtraError: if numba is not installed.
        MissingFileError, UnknownFormatError: if there is something wrong with the background image.
    """
    camera, motions = config.camera.build(), motions_of(config)
    meshes = tuple(make_mesh(item.shape, item.scale) for item in config.objects)
    duration_us = max(1, round(config.duration_s * 1e6))
    t_us, worst_px = frame_times(motions, [outer_points(mesh) for mesh in meshes], camera, duration_us, config.max_motion_px)
    events = _events(config, camera, render_frames(config, t_us, meshes), t_us, progress)
    return SimulatedSequence(
        config.name,
        events,
        camera,
        tuple(item.label for item in config.objects),
        meshes,
        tuple(ground_truth(motion, duration_us) for motion in motions),
        _meta(config, len(t_us), worst_px),
    )


def _events(config: SceneConfig, camera: Camera, frames: Iterator[Frame], t_us: Int[ndarray, "p"], progress: Progress | None) -> EventBatch:
    """Events that the frames cause."""
    sensor = EventCamera(config.event_camera_config, camera.width, camera.height, config.seed)
    previous = next(frames)
    state, batches = sensor.start(torch.from_numpy(previous.luminance), int(t_us[0])), []
    for done, (frame, frame_us) in enumerate(zip(frames, t_us[1:].tolist(), strict=True), start=1):
        changed = [region.slices for region in merge_regions([*previous.regions, *frame.regions])]
        state, events = sensor.step(state, torch.from_numpy(frame.luminance), frame_us, changed)
        batches.append(events)
        previous = frame
        if progress is not None:
            progress(done / (len(t_us) - 1))
    return concatenate(batches)


def _meta(config: SceneConfig, frames: int, worst_px: float) -> dict[str, Any]:
    """Settings and facts, under the names that sequences of this layout use."""
    return {
        "name": config.name,
        "duration_s": config.duration_s,
        "speed": config.speed,
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


def write(sequence: SimulatedSequence, path: str | Path) -> Path:
    """Write a sequence to the ``.npz`` file ``path``, with its meshes beside it; see :mod:`torchtrack.io.sequence`.

    Raises:
        EventDataError: if ``path`` is not a ``.npz`` file.
    """
    events = sequence.events
    write_sequence(
        path,
        x=events.x.numpy(),
        y=events.y.numpy(),
        t_us=events.t_us.numpy(),
        polarity=events.polarity.numpy().astype(np.uint8),
        camera=sequence.camera,
        labels=sequence.labels,
        # A texture doubles vertices along its seams; the bare geometry needs each of them once.
        meshes=[trimesh.Trimesh(mesh.vertices, mesh.faces, process=True) for mesh in sequence.meshes],
        trajectories=sequence.trajectories,
        meta=sequence.meta,
        textured=[mesh if isinstance(mesh.visual, trimesh.visual.TextureVisuals) else None for mesh in sequence.meshes],
    )
    return Path(path)
