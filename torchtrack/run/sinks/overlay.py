"""The video of a run and its stills."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from torchtrack.config.run import OverlayConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.atomic import writing
from torchtrack.core.events import pad_streams
from torchtrack.core.windows import EventWindow
from torchtrack.run.session import Session
from torchtrack.run.stepping import Step
from torchtrack.tracking.frontend.bursts import update_bursts
from torchtrack.tracking.frontend.flow import estimate_flow
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.sensors import Sensors, sensor_tables
from torchtrack.tracking.frontend.tiles import SensorTiles
from torchtrack.tracking.frontend.time_surface import update_last_event
from torchtrack.tracking.state import StepResult, each_tensor
from torchtrack.viz import OverlayWriter, draw_overlay, overlay_objects

# Corners that are drawn of each object, where the tracker has none.
_CORNERS = 32


class _Drawing:
    """Pictures of steps.

    Corners and flow are those that the tracker made use of. Where it has none, some are found here, and the picture says so.
    """

    def __init__(self, session: Session, tracker: TrackerConfig) -> None:
        self._session, self._config, self._note = session, _with_corners(tracker), note(tracker)
        self._has_corners = tracker.corners.max_corners > 0
        first_stream = torch.zeros(len(session.models), dtype=torch.int64)
        tables = sensor_tables([session.camera])
        self._sensors = Sensors(*tables, stream_index=first_stream, tiles=SensorTiles(tables[0]))
        self._maps = SensorMaps.empty(1, self._sensors.image_size, torch.device("cpu"))

    def see(self, step: Step) -> None:
        """Take the events of a step."""
        self._maps = self._updated(step.window)

    def draw(self, step: Step) -> UInt8[np.ndarray, "h w 3"]:
        """The step that was seen last."""
        window, session = step.window, self._session
        t_us = window.t_end_us
        truth = [trajectory.at(torch.tensor([t_us]))[0] if trajectory is not None else None for trajectory in session.ground_truth]
        result = each_tensor(Tensor.cpu, step.result)
        result = result if self._has_corners else self._for_display(result, window)
        objects = overlay_objects(result, session.models, session.camera, names=session.labels, true_poses=truth)
        return draw_overlay(self._maps.last_event_us[0], t_us, session.camera, objects, note=self._note)

    def _updated(self, window: EventWindow) -> SensorMaps:
        """The maps of the sensor with a window more; of bursts where they are looked at."""
        last_event_us, t_us = update_last_event(self._maps.last_event_us, window.events), torch.tensor([window.t_end_us])
        if self._has_corners:
            return replace(self._maps, last_event_us=last_event_us)
        elapsed_us, events = torch.tensor([window.t_end_us - window.t_start_us]), pad_streams(window.events, 1, t_us)
        return SensorMaps(last_event_us, update_bursts(self._maps.burst_age_us, elapsed_us, events))

    def _for_display(self, result: StepResult, window: EventWindow) -> StepResult:
        """The result of a step with the corners around its contours and their flow."""
        window_s, t_us = torch.tensor([1e-6 * (window.t_end_us - window.t_start_us)]), torch.tensor([window.t_end_us])
        view = self._sensors.view(self._maps, t_us)
        corners = self._sensors.corners(result.contours, view, window_s, self._config)
        flow, has_flow = estimate_flow(corners.points, view, self._config.flow)
        return replace(result, corners=replace(corners, flow=flow, has_flow=has_flow))


class Overlay:
    """Draws the windows that the video has a frame for into ``path``, such as ``overlay.mp4``."""

    def __init__(self, path: Path, session: Session, config: OverlayConfig, tracker: TrackerConfig) -> None:
        self._drawing = _Drawing(session, tracker)
        self._writer = OverlayWriter(path, frames_per_second=config.frames_per_second, slow_motion=config.slow_motion, stills=config.stills)

    def add(self, step: Step) -> None:
        """Draw one step, if it is due."""
        self._drawing.see(step)
        if self._writer.is_due(step.window.t_end_us):
            self._writer.add(step.window.t_end_us, self._drawing.draw(step))

    def close(self) -> None:
        """Finish the video."""
        self._writer.close()


class FirstStill:
    """Draws the very first window into ``path``, a PNG: does the pose that a run starts from lie on the events?"""

    def __init__(self, path: Path, session: Session, tracker: TrackerConfig) -> None:
        self._path, self._drawing, self._is_drawn = path, _Drawing(session, tracker), False

    def add(self, step: Step) -> None:
        """Draw the first step; pass over the others."""
        if self._is_drawn:
            return
        self._is_drawn = True
        self._drawing.see(step)
        _, png = cv2.imencode(".png", self._drawing.draw(step))
        with writing(self._path):
            self._path.write_bytes(png.tobytes())

    def close(self) -> None:
        """Nothing is open."""


def note(tracker: TrackerConfig) -> str:
    """What is drawn in yellow, in words."""
    if not tracker.corners.max_corners:
        return "yellow: corners and their normal flow, not used in tracking"
    return "yellow: corners" if tracker.association.search == "nearest" else "yellow: corners and their flow"


def _with_corners(config: TrackerConfig) -> TrackerConfig:
    """The settings with corners switched on."""
    corners = config.corners.model_copy(update={"max_corners": config.corners.max_corners or _CORNERS})
    return config.model_copy(update={"corners": corners})
