"""The video of a run and its stills."""

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchtrack.config.run import OverlayConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.run.session import Session
from torchtrack.run.stepping import Step
from torchtrack.tracking.frontend.sensors import Sensors, sensor_tables
from torchtrack.tracking.frontend.time_surface import empty_last_event, update_last_event
from torchtrack.tracking.state import StepResult, each_tensor
from torchtrack.viz import OverlayWriter, draw_overlay, overlay_objects

# Corners that are drawn of each object, where the tracker makes no use of any.
_CORNERS = 32


class Overlay:
    """Draws the windows that the video has a frame for into ``path``, such as ``overlay.mp4``.

    Time surface, corners and their flow are found here: not every tracker needs them.
    """

    def __init__(self, path: Path, session: Session, config: OverlayConfig, tracker: TrackerConfig) -> None:
        self._session, self._config = session, _with_corners(tracker)
        first_stream = torch.zeros(len(session.models), dtype=torch.int64)
        self._sensors = Sensors(*sensor_tables([session.camera]), stream_index=first_stream, tiles=None)
        self._last_event_us = empty_last_event(1, *self._sensors.image_size)
        self._writer = OverlayWriter(path, frames_per_second=config.frames_per_second, slow_motion=config.slow_motion, stills=config.stills)

    def add(self, step: Step) -> None:
        """Draw one step, if it is due."""
        t_us, session = step.window.t_end_us, self._session
        self._last_event_us = update_last_event(self._last_event_us, step.window.events)
        if not self._writer.is_due(t_us):
            return
        truth = [trajectory.at(torch.tensor([t_us]))[0] if trajectory is not None else None for trajectory in session.ground_truth]
        objects = overlay_objects(self._with_corners(step), session.models, session.camera, names=session.labels, true_poses=truth)
        self._writer.add(t_us, draw_overlay(self._last_event_us[0], t_us, session.camera, objects))

    def _with_corners(self, step: Step) -> StepResult:
        """The result of a step with the corners around its contours and their flow."""
        result, window = each_tensor(Tensor.cpu, step.result), step.window
        window_s = torch.tensor([1e-6 * (window.t_end_us - window.t_start_us)])
        t_us = torch.tensor([window.t_end_us])
        corners = self._sensors.corners(result.contours, self._last_event_us, t_us, window_s, self._config)
        return replace(result, corners=self._sensors.with_flow(corners, self._last_event_us, t_us, self._config))

    def close(self) -> None:
        """Finish the video."""
        self._writer.close()


def _with_corners(config: TrackerConfig) -> TrackerConfig:
    """The settings with corners switched on."""
    corners = config.corners.model_copy(update={"max_corners": config.corners.max_corners or _CORNERS})
    return config.model_copy(update={"corners": corners})
