"""What a sequence is, however it is stored."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchtrack.core.camera import Camera
from torchtrack.io.event_source import EventSource
from torchtrack.io.trajectory import Trajectory


@dataclass(frozen=True)
class SequenceObject:
    """One object of a sequence: its label, its model files, and its true poses where they are known."""

    label: str
    mesh_path: Path
    textured_path: Path | None = None
    ground_truth: Trajectory | None = None

    def model_path(self, models: Literal["textured", "geometry"] = "textured") -> Path:
        """The model file to use: the textured one where it is asked for and there, else the geometry."""
        return self.textured_path if models == "textured" and self.textured_path is not None else self.mesh_path


@dataclass(frozen=True)
class Sequence:
    """A recorded or simulated sequence; its events are streamed, not held.

    ``extra`` holds small further arrays where there are any: ``velocity``, ``occluder_poses``, ``occluder_labels``.
    """

    name: str
    events: EventSource
    camera: Camera
    objects: tuple[SequenceObject, ...]
    meta: dict[str, Any] = field(default_factory=dict)
    extra: dict[str, np.ndarray] = field(default_factory=dict)
