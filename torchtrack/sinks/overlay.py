"""The video of a run and its stills."""

from pathlib import Path

import torch

from torchtrack.config.run import OverlayConfig
from torchtrack.session import Session
from torchtrack.stepping import Step
from torchtrack.viz import OverlayWriter, draw_overlay, overlay_objects


class Overlay:
    """Draws the windows that the video has a frame for into ``overlay.mp4``."""

    def __init__(self, folder: Path, session: Session, config: OverlayConfig) -> None:
        self._session = session
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
        objects = overlay_objects(step.result, session.models, session.camera, names=session.labels, true_poses=truth)
        self._writer.add(t_us, draw_overlay(step.state.last_event_us[0], t_us, session.camera, objects))

    def close(self) -> None:
        """Finish the video."""
        self._writer.close()
