"""The video of a run and its stills."""

from dataclasses import replace
from pathlib import Path

import torch

from torchtrack.camera import undistortion_table
from torchtrack.config.run import OverlayConfig
from torchtrack.config.tracker import FlowConfig
from torchtrack.flow import estimate_flow
from torchtrack.session import Session
from torchtrack.state import StepResult
from torchtrack.stepping import Step
from torchtrack.viz import OverlayWriter, draw_overlay, overlay_objects


class Overlay:
    """Draws the windows that the video has a frame for into ``overlay.mp4``, with the flow of their corners."""

    def __init__(self, folder: Path, session: Session, config: OverlayConfig, flow: FlowConfig) -> None:
        self._session, self._flow, self._ideal_pixels = session, flow, undistortion_table(session.camera)[None]
        self._writer = OverlayWriter(
            folder / "overlay.mp4", frames_per_second=config.frames_per_second, slow_motion=config.slow_motion, stills=config.stills
        )

    def add(self, step: Step) -> None:
        """Draw one step, if it is due."""
        t_us, session = step.window.t_end_us, self._session
        if not self._writer.is_due(t_us):
            return
        at = torch.tensor([t_us])
        truth = [trajectory.at(at)[0] if trajectory is not None else None for trajectory in session.ground_truth]
        objects = overlay_objects(self._with_flow(step), session.models, session.camera, names=session.labels, true_poses=truth)
        self._writer.add(t_us, draw_overlay(step.state.last_event_us[0], t_us, session.camera, objects))

    def _with_flow(self, step: Step) -> StepResult:
        """The result of a step with the flow of its corners, which the tracker leaves out where it makes no use of it."""
        corners, last_event_us = step.result.corners, step.state.last_event_us
        stream_index = torch.zeros(len(corners.mask), dtype=torch.int64, device=last_event_us.device)
        ideal_pixels = self._ideal_pixels.to(corners.pixels)
        return replace(step.result, corners=estimate_flow(corners, last_event_us, step.state.t_us, stream_index, ideal_pixels, self._flow))

    def close(self) -> None:
        """Finish the video."""
        self._writer.close()
