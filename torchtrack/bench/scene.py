"""Scenes to measure the tracker on: simulated ones of moving objects, made when they are needed, or a given sequence.

Events come from the simulator, with its noise, and the tracker really tracks: what it gave is compared with the truth. Where it
is lost, searches would be measured.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.bench.clock import Clock
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.run import RunConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.camera import Camera, project
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.core.lie import rotation_angle_deg, transform_points
from torchtrack.core.windows import clipped
from torchtrack.errors import ConfigError
from torchtrack.io import Trajectory
from torchtrack.object_model import ObjectModel
from torchtrack.run.session import open_session
from torchtrack.sim import SceneConfig, simulate
from torchtrack.sim.meshes import make_mesh
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.tracker import Tracker
from torchtrack.tracking.validation.status import Status

SHAPES = ("lbracket", "cube", "satellite", "robot")
"""Creases alone; print alone, nearly; both; a dense mesh."""
VGA, HD = (640, 480), (1280, 720)
DURATION_S = 0.2
# Windows before those that are measured: velocities are learned in them.
WARM_UP_WINDOWS = 8
_FOCAL_PX, _FREQUENCY_HZ = 600.0, 2.0
# Diameter of an object (px): this, or this share of its cell's size where that is less.
_DIAMETER_PX, _FILL = 200.0, 0.8
# How far an object swings, and how far its fastest point comes in a second, in diameters.
_SWING, _DIAMETERS_PER_S = 0.15, 3.75
# Events that are to be outside an object keep this far from its bounding box (px).
_CLEAR_PX = 32


@dataclass(frozen=True)
class Scene:
    """Events of a stream, and what moves in it.

    Args:
        events: sorted by time, from 1 µs on.
        source: number of the object that each event is of; negative for none.
        camera: the camera.
        models: of the objects; alike ones share theirs.
        truth: true poses; None where they are not known.
        T_cam_obj: poses at the start.
        start_us, end_us: when it starts and ends.
    """

    events: EventBatch
    source: Tensor | None
    camera: Camera
    models: tuple[ObjectModel, ...]
    truth: tuple[Trajectory | None, ...]
    T_cam_obj: Float[Tensor, "b 4 4"]
    start_us: int
    end_us: int

    @property
    def mev_per_s(self) -> float:
        """Millions of events per second."""
        return len(self.events) / (self.end_us - self.start_us)

    def first(self, count: int) -> "Scene":
        """The first ``count`` objects, and no events of the others."""
        if self.source is None or count >= len(self.models):
            return self
        kept = self.source < count
        few = {name: getattr(self, name)[:count] for name in ("models", "truth", "T_cam_obj")}
        return replace(self, events=self.events[kept], source=self.source[kept], **few)

    def windows(self, duration_us: int) -> list[tuple[EventBatch, int]]:
        """Events and end of each window."""
        ends = range(self.start_us + duration_us, self.end_us + 1, duration_us)
        return [(self.events.slice_time(end_us - duration_us, end_us), end_us) for end_us in ends]


@cache
def simulated(shapes: tuple[str, ...], columns: int = 1, size: tuple[int, int] = VGA, duration_s: float | None = None) -> Scene:
    """Objects that swing and turn side by side, each in a cell of its own of the image.

    Args:
        shapes: one per object.
        columns: cells in a row.
        size: width and height of the sensor.
        duration_s: how long; :data:`DURATION_S` when not given.

    Raises:
        MissingExtraError: if the simulator's libraries are not installed.
    """
    config = _config(shapes, columns, size, duration_s or DURATION_S)
    sequence = simulate(config)
    models = {shape: ObjectModel.from_mesh(make_mesh(shape), name=shape) for shape in shapes}
    first = torch.stack([trajectory.at(torch.tensor([0]))[0] for trajectory in sequence.trajectories])
    own = tuple(models[shape] for shape in shapes)
    return Scene(sequence.events, sequence.source, sequence.camera, own, sequence.trajectories, first, 0, round(1e6 * config.duration_s))


def _config(shapes: tuple[str, ...], columns: int, size: tuple[int, int], duration_s: float) -> SceneConfig:
    width, height = size
    cell = (width / columns, height / -(-len(shapes) // columns))
    diameter_px = min(_DIAMETER_PX, _FILL * (cell[0] * cell[1]) ** 0.5)
    objects = []
    for number, shape in enumerate(shapes):
        u, v = ((place + 0.5) * extent - full / 2 for place, extent, full in zip((number % columns, number // columns), cell, size, strict=True))
        objects.append(_object(number, shape, (u, v), diameter_px))
    camera = {"width": width, "height": height, "fx": _FOCAL_PX, "fy": _FOCAL_PX}
    values = {"objects": objects, "camera": camera, "duration_s": duration_s, "peak_speed": _DIAMETERS_PER_S * diameter_px, "seed": 1}
    return SceneConfig.model_validate({"name": "bench", **values})


def _object(number: int, shape: str, place_px: tuple[float, float], diameter_px: float) -> dict[str, Any]:
    """One object, of a size and at a place of the image, in an orientation of its own."""
    diameter_m = float(np.linalg.norm(make_mesh(shape).extents))
    z = _FOCAL_PX * diameter_m / diameter_px
    motion = {
        "position_m": (place_px[0] * z / _FOCAL_PX, place_px[1] * z / _FOCAL_PX, z),
        "rotation_deg": (20 + 37 * number % 50, 30 - 23 * number % 60, 10 * number % 360),
        "translation_amplitude_m": (_SWING * diameter_m,) * 3,
        "frequency_hz": _FREQUENCY_HZ,
    }
    return {"label": f"{shape}{number}", "shape": shape, "motion": motion}


def shapes_of(count: int) -> tuple[str, ...]:
    """``count`` shapes, all kinds by turns."""
    return tuple(SHAPES[number % len(SHAPES)] for number in range(count))


def read(path: Path) -> Scene:
    """The scene of a sequence on disk, as long as the simulated ones.

    Raises:
        TorchtrackError: of the kind that fits, if the sequence cannot be read.
    """
    session = open_session(RunConfig(source=path))
    end_us = session.start_us + round(1e6 * DURATION_S)
    if session.expected_end_us is not None:
        end_us = min(end_us, session.expected_end_us)
    events = concatenate(clipped(session.events.chunks(), session.start_us, end_us))
    return Scene(events, None, session.camera, session.models, session.ground_truth, session.T_cam_obj, session.start_us, end_us)


def with_events_outside(scene: Scene, mev_per_s: float, seed: int = 0) -> Scene:
    """The scene with further events all over the image, but none where any of its objects ever is.

    Args:
        scene: the scene.
        mev_per_s: rate of the further events (millions per second).
        seed: of their places and times.
    """
    free = np.flatnonzero(_outside(scene))
    if len(free) == 0:
        raise ConfigError("the objects fill the whole image: there is no room for events beside them.")
    random = np.random.default_rng(seed)
    duration_us = scene.end_us - scene.start_us
    count = round(mev_per_s * duration_us)
    places, times = free[random.integers(0, len(free), count)], np.sort(random.integers(1, duration_us + 1, count)) + scene.start_us
    further = EventBatch.from_numpy(places % scene.camera.width, places // scene.camera.width, times, random.integers(0, 2, count))
    events = concatenate([scene.events, further])
    return replace(scene, events=events[events.t_us.sort(stable=True).indices], source=None)


def _outside(scene: Scene) -> np.ndarray:
    """Mask of the pixels that are never near any object."""
    free = np.ones((scene.camera.height, scene.camera.width), dtype=bool)
    intrinsics = scene.camera.intrinsics(torch.float64)
    for model, truth in zip(scene.models, scene.truth, strict=True):
        poses = truth.T_cam_obj if truth is not None else scene.T_cam_obj
        half = 0.5 * (model.surface_points.amax(0) - model.surface_points.amin(0)).double()
        signs = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=torch.float64)
        corners = (model.centre.double() + signs * half).expand(len(poses), -1, -1)
        pixels = project(transform_points(poses, corners), intrinsics.expand(len(poses), 4)).flatten(0, 1)
        (left, top), (right, bottom) = (pixels.amin(0) - _CLEAR_PX).long().tolist(), (pixels.amax(0) + _CLEAR_PX).long().tolist()
        free[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = False
    return free


@dataclass(frozen=True)
class Run:
    """A tracker in full motion, and the windows that come next.

    Args:
        tracker: the tracker.
        state: after the warm-up.
        windows: events, on the tracker's device, and end of each window.
        truth: true poses of the objects of the first stream.
    """

    tracker: Tracker
    state: TrackerState
    windows: list[tuple[EventBatch, int]]
    truth: Sequence[Trajectory | None]

    def latencies(self, clock: Clock, on_step: Callable[[StepResult], None] | None = None) -> list[float]:
        """Time of each step (s)."""
        state, seconds = self.state, []
        with torch.inference_mode():
            for events, end_us in self.windows:
                begun = clock.now()
                state, result = self.tracker.step(state, events, end_us)
                seconds.append(clock.now() - begun)
                if on_step is not None:
                    on_step(result)
        return seconds

    def after(self, count: int) -> "Run":
        """The same tracker, ``count`` windows later."""
        state = self.state
        with torch.inference_mode():
            for events, end_us in self.windows[:count]:
                state, _ = self.tracker.step(state, events, end_us)
        return replace(self, state=state, windows=self.windows[count:])

    def quality(self, clock: Clock) -> str:
        """How well it tracked, in words."""
        results: list[StepResult] = []
        self.latencies(clock, results.append)
        status = torch.stack([result.status for result in results])
        tracking = f"{float((status == int(Status.TRACKING)).float().mean()):.1%} of poses are TRACKING"
        errors = [self._errors(result) for result in results]
        if not errors[0].numel():
            return tracking
        angle_deg, way_mm = torch.cat(errors).median(0).values.tolist()
        return f"{tracking}, median error {angle_deg:.2f}° and {way_mm:.2f} mm"

    def _errors(self, result: StepResult) -> Float[Tensor, "o 2"]:
        """Rotation (degrees) and translation (mm) of the objects whose truth is known."""
        known = [number for number, truth in enumerate(self.truth) if truth is not None]
        true = [truth.at(result.t_us[:1].cpu())[0] for truth in self.truth if truth is not None]
        if not known:
            return torch.zeros(0, 2)
        estimated, expected = result.T_cam_obj[known].cpu(), torch.stack(true)
        return torch.stack([rotation_angle_deg(estimated[:, :3, :3], expected[:, :3, :3]), 1e3 * (estimated - expected)[:, :3, 3].norm(dim=-1)], -1)


def started(
    scenes: Sequence[Scene], device: torch.device, *, compiled: bool = False, kernels: bool = True, search: RelocalizationConfig | None = None
) -> Run:
    """A tracker that follows scenes of the same time, after its first windows.

    Args:
        scenes: what the camera of each stream sees.
        device: where the tracker runs.
        compiled: whether steady windows are taken by compiled graphs.
        kernels: whether kernels of a backend are used where they apply.
        search: how lost objects are searched for; as usual when not given.

    Raises:
        ConfigError: if the scenes end with their first windows.
    """
    first, models = scenes[0], [model for scene in scenes for model in scene.models]
    index = [stream for stream, scene in enumerate(scenes) for _ in scene.models]
    config = TrackerConfig(relocalization=search or RelocalizationConfig())
    tracker = Tracker(models, [scene.camera for scene in scenes], config, index, compiled=compiled, kernels=kernels).to(device)
    state = tracker.init(torch.cat([scene.T_cam_obj for scene in scenes]), first.start_us)
    tracker.prepare(state)
    windows = []
    for together in zip(*(scene.windows(tracker.config.window.duration_us) for scene in scenes), strict=True):
        events = concatenate([own.of_stream(stream) for stream, (own, _) in enumerate(together)])
        windows.append((events.to(device), together[0][1]))
    if len(windows) <= WARM_UP_WINDOWS:
        needed = f"more than {WARM_UP_WINDOWS} windows of {tracker.config.window.duration_us} µs"
        raise ConfigError(f"there is nothing to measure: {needed} are needed, and the scene lasts {first.end_us - first.start_us} µs.")
    with torch.inference_mode():
        for events, end_us in windows[:WARM_UP_WINDOWS]:
            state, _ = tracker.step(state, events, end_us)
    return Run(tracker, state, windows[WARM_UP_WINDOWS:], first.truth)
