"""What a run tracks: events, camera, object models, the initial poses, and the truth where it is known."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.events import EventsConfig
from torchtrack.config.run import CameraConfig, ObjectConfig, RunConfig
from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch
from torchtrack.core.files import naming
from torchtrack.core.limits import check_limit, limits
from torchtrack.core.windows import EventWindow, clipped
from torchtrack.errors import CalibrationError, ConfigError, EventDataError, TorchtrackWarning
from torchtrack.io import EventSource, SequenceObject, Trajectory, is_sequence, open_events, read_calibration, read_sequence
from torchtrack.io.event_source import DEFAULT_CHUNK_EVENTS
from torchtrack.io.filters import BackgroundFilter, Downscaled, HotPixelFilter, Region, downscaled_camera, find_hot_pixels, region_camera
from torchtrack.io.keep_up import KeepUp
from torchtrack.io.live import open_live
from torchtrack.io.live_source import LiveSource
from torchtrack.io.polarity_code import with_one_polarity_reported
from torchtrack.io.problems import Problems
from torchtrack.io.reading import Reading
from torchtrack.object_model import ObjectModel
from torchtrack.run.initial_pose import initial_pose

# A pose from longer before the first event is doubtful: an object that moves fires events. From so long, the clocks differ.
_DOUBTFUL_START_S, _FARTHEST_START_S = 1.0, 10.0


@dataclass(frozen=True)
class Session:
    """One stream, its camera, and the objects to track in it.

    Args:
        name: what the source is called.
        events: the stream.
        camera: its camera.
        labels, models, ground_truth: one per object; the truth is None where it is not known.
        T_cam_obj: ``[B, 4, 4]`` float64, the initial poses.
        start_us: time of the initial poses.
        end_us: where tracking ends, or None for the end of the stream.
        live: the live source that the events are from, or None for a file.
        live_windows: how many windows of a live source may wait.
        problems: what was wrong with the events that were read, where their source counts it.
        reading: how far the file was read, where it is one.
    """

    name: str
    events: EventSource
    camera: Camera
    labels: tuple[str, ...]
    models: tuple[ObjectModel, ...]
    ground_truth: tuple[Trajectory | None, ...]
    T_cam_obj: Float[Tensor, "b 4 4"]
    start_us: int
    end_us: int | None
    live: LiveSource | None = None
    live_windows: int = 64
    problems: Problems | None = None
    reading: Reading | None = None

    def chunks(self) -> Iterator[EventBatch]:
        """The events after the start and up to the end."""
        return with_one_polarity_reported(clipped(self.events.chunks(), self.start_us, self.end_us), f"'{self.name}'")

    def with_objects(self, numbers: Sequence[int]) -> "Session":
        """The same stream, with some of the objects."""
        return replace(
            self,
            labels=tuple(self.labels[number] for number in numbers),
            models=tuple(self.models[number] for number in numbers),
            ground_truth=tuple(self.ground_truth[number] for number in numbers),
            T_cam_obj=self.T_cam_obj[list(numbers)],
        )

    def keep_up(self, windows: Iterator[EventWindow]) -> KeepUp | None:
        """The ``windows`` of a live source, joined where they come too fast; None for a file."""
        return None if self.live is None else KeepUp(windows, self.live_windows, self.live.stop)

    @property
    def expected_end_us(self) -> int | None:
        """Where tracking will end: as the settings or the truth say, else as what was read of the file lets expect; None of a live source."""
        if self.end_us is not None:
            return self.end_us
        ends = [int(truth.t_us[-1]) for truth in self.ground_truth if truth is not None]
        if ends:
            return max(ends)
        return None if self.reading is None else self.reading.expected_end_us


@dataclass(frozen=True)
class EarlierEvents:
    """A stream with the latency of its sensor taken off all time stamps.

    Args:
        source: the stream.
        latency_us: how late its time stamps are.
    """

    source: EventSource
    latency_us: int

    @property
    def width(self) -> int:
        """Sensor width in pixels."""
        return self.source.width

    @property
    def height(self) -> int:
        """Sensor height in pixels."""
        return self.source.height

    def chunks(self, max_events: int = DEFAULT_CHUNK_EVENTS) -> Iterator[EventBatch]:
        """The events in time order, at the times when they happened."""
        for batch in self.source.chunks(max_events):
            yield replace(batch, t_us=batch.t_us - self.latency_us)


def open_session(config: RunConfig) -> Session:
    """Open everything that a run needs.

    Raises:
        TorchtrackError: of the kind that fits, if a file, model, camera or pose is missing or wrong.
        EventDataError: if the stream has no events in the time asked for.
    """
    with limits(config.limits):
        return _opened(config)


def _opened(config: RunConfig) -> Session:
    name, source, camera, of_sequence = _open_source(config)
    with naming(Path(config.source)):
        events, camera = prepared(source, camera, config.events)
    if config.sensor_latency_us:
        events = EarlierEvents(events, config.sensor_latency_us)
    chosen = config.objects or tuple(ObjectConfig(label=label) for label in of_sequence)
    if not chosen:
        raise ConfigError(f"objects: '{config.source}' brings no objects of its own. List those to track, each with a mesh and an initial_pose.")
    known = tuple(_matching(obj, of_sequence, config.source) for obj in chosen)
    truth = tuple(obj.ground_truth if obj else None for obj in known)
    start_us = _start(config, events, truth)
    poses = [initial_pose(*pair, start_us) for pair in zip(chosen, truth, strict=True)]
    return Session(
        name=name,
        events=events,
        camera=camera,
        labels=tuple(obj.label for obj in chosen),
        models=tuple(_load_model(obj, in_sequence, config) for obj, in_sequence in zip(chosen, known, strict=True)),
        ground_truth=truth,
        T_cam_obj=torch.stack(poses),
        start_us=start_us,
        end_us=config.end_us,
        live=source if isinstance(source, LiveSource) else None,
        live_windows=config.events.live_windows,
        problems=getattr(source, "problems", None),
        reading=getattr(source, "reading", None),
    )


def prepared(events: EventSource, camera: Camera, config: EventsConfig) -> tuple[EventSource, Camera]:
    """Events after the configured stages, and the camera as it sees them."""
    if config.hot_pixels:
        if isinstance(events, LiveSource):
            raise ConfigError("events.hot_pixels: hot pixels are found in a file, not in a live source. Leave it out.")
        events = HotPixelFilter(events, find_hot_pixels(events))
    if config.region is not None:
        events, camera = Region(events, *config.region), region_camera(camera, *config.region)
    if config.downscale > 1:
        events, camera = Downscaled(events, config.downscale), downscaled_camera(camera, config.downscale)
    if config.background_us is not None:
        events = BackgroundFilter(events, config.background_us)
    return events, camera


def _open_source(config: RunConfig) -> tuple[str, EventSource, Camera, dict[str, SequenceObject]]:
    """Name, events and camera of the source, and the objects it knows by label."""
    if isinstance(config.source, str):
        return _open_live(config.source, config.camera)
    if is_sequence(config.source):
        sequence = read_sequence(config.source, config.events.strict, choices=config.events)
        camera = _sequence_camera(config.camera, sequence.events, config.source) if config.camera else sequence.camera
        return sequence.name, sequence.events, camera, {obj.label: obj for obj in sequence.objects}
    if config.camera is None:
        # Opened first, so that a file that is not there or is not one of events is told as such.
        open_events(config.source, choices=config.events)
        raise ConfigError(f"camera: '{config.source}' holds events alone. Give a calibration file, or fx, fy, cx, cy, width and height.")
    camera = _camera(config.camera)
    return config.source.stem, open_events(config.source, camera.width, camera.height, config.events.strict, config.events), camera, {}


def _open_live(source: str, config: CameraConfig | None) -> tuple[str, EventSource, Camera, dict[str, SequenceObject]]:
    if config is None:
        raise ConfigError(f"camera: '{source}' sends events alone. Give a calibration file, or fx, fy, cx, cy, width and height.")
    camera = _camera(config)
    live = open_live(source, camera.width, camera.height)
    if (live.width, live.height) != (camera.width, camera.height):
        sizes = f"{live.width}x{live.height} pixels, but the camera {camera.width}x{camera.height}"
        raise ConfigError(f"camera: '{source}' has {sizes}. Correct the calibration.")
    return "live", live, camera, {}


def _camera(config: CameraConfig) -> Camera:
    if config.calibration is not None:
        sizes = config.width, config.height
        return read_calibration(config.calibration, *sizes, name=config.name, distortion_model=config.distortion_model)
    check_limit("sensor_pixels", (config.width or 0) * (config.height or 0), "camera")
    given = config.model_dump(exclude={"calibration", "name"})
    try:
        return Camera(**{**given, "distortion_model": config.distortion_model or "none"})
    except CalibrationError as error:
        raise CalibrationError(f"camera: {error}") from error


def _sequence_camera(config: CameraConfig, events: EventSource, source: Path) -> Camera:
    """A camera given in place of the one that a sequence brings."""
    camera = _camera(config)
    if (camera.width, camera.height) != (events.width, events.height):
        sizes = f"{events.width}x{events.height} pixels, but the camera {camera.width}x{camera.height}"
        raise ConfigError(f"camera: '{source}' has {sizes}. Correct the calibration, or leave the camera out.")
    return camera


def _matching(obj: ObjectConfig, of_sequence: dict[str, SequenceObject], source: Path | str) -> SequenceObject | None:
    """The object of the sequence that a configured one names, or None where it brings its own model."""
    in_sequence = of_sequence.get(obj.label)
    if in_sequence is None and obj.mesh is None and obj.polylines is None:
        known = f"its objects are {', '.join(of_sequence)}" if of_sequence else "it brings none of its own"
        raise ConfigError(f"objects: '{obj.label}' has no model, and '{source}' knows no such object ({known}). Give mesh or polylines.")
    return in_sequence


def _load_model(obj: ObjectConfig, in_sequence: SequenceObject | None, config: RunConfig) -> ObjectModel:
    if obj.centre and in_sequence is not None and in_sequence.ground_truth is not None:
        known = f"'{config.source}' knows poses of '{obj.label}', which are of the origin of its own model"
        raise ConfigError(f"objects: centre: {known}. Leave centre out, or give the object another label.")
    placed: dict[str, Any] = {"name": obj.label, "unit": obj.unit, "scale": obj.scale, "centre": obj.centre}
    if obj.polylines is not None:
        return ObjectModel.from_polylines(obj.polylines, **placed)
    if obj.mesh is not None:
        return ObjectModel.from_file(obj.mesh, **placed)
    if in_sequence is None:
        raise ConfigError(f"objects: '{obj.label}' has no model.")
    return ObjectModel.from_file(in_sequence.model_path(config.models), name=obj.label)


def _start(config: RunConfig, events: EventSource, truth: tuple[Trajectory | None, ...]) -> int:
    """Time of the initial poses: as configured, else the first moment that has events and, where there is truth, truth."""
    before = config.start_us if config.start_us is not None else -(2**62)
    first = next(clipped(events.chunks(), before, config.end_us), None)
    if first is None:
        raise EventDataError(_no_events(config, events))
    if config.start_us is not None:
        _check_start(config, int(first.t_us[0]))
        return config.start_us
    return max([int(first.t_us[0]) - 1, *(int(trajectory.t_us[0]) for trajectory in truth if trajectory is not None)])


def _no_events(config: RunConfig, events: EventSource) -> str:
    """That there is nothing to track with, and where events are."""
    span = f"after {config.start_us} µs " if config.start_us is not None else ""
    span += f"up to {config.end_us} µs " if config.end_us is not None else ""
    of_all = None if isinstance(events, LiveSource) else next(iter(events.chunks()), None)
    where = "" if of_all is None else f" Its first event is at {int(of_all.t_us[0])} µs."
    return f"'{config.source}' has no events {span}to track with.{where} Check the file, and start_us and end_us: they are in the time of its events."


def _check_start(config: RunConfig, first_us: int) -> None:
    """Refuse initial poses from long before the first event, which are likely on another clock; tell of those from some time before."""
    before_s = 1e-6 * (first_us - (config.start_us or 0))
    message = f"start_us: the initial pose is of {config.start_us} µs, but the first event of '{config.source}' after that is at {first_us} µs, "
    if before_s > _FARTHEST_START_S:
        raise ConfigError(f"{message}{before_s:.0f} s later: they are on different clocks. Leave start_us out, or give it in the time of the events.")
    if before_s > _DOUBTFUL_START_S:
        warnings.warn(f"{message}{before_s:.1f} s later. It is taken to have stayed there. Check start_us.", TorchtrackWarning, stacklevel=2)
