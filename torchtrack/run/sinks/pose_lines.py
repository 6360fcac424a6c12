"""Poses as lines of JSON while a run goes on, for another program that reads them: one line per window and object."""

import json
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.lie import quaternion_from_rotation, with_signs_of
from torchtrack.run.sinks.summary import finite
from torchtrack.run.stepping import Step
from torchtrack.tracking.state import StepResult
from torchtrack.tracking.validation.status import Status


@runtime_checkable
class Lines(Protocol):
    """Where lines go: a file, or standard output."""

    def write(self, lines: str) -> None:
        """Write lines, each with its end, at once."""
        ...

    def close(self) -> None:
        """No more lines come."""
        ...


class PoseLines:
    """Writes lines as soon as a step is taken. Quaternions have no jump of sign.

    Args:
        lines: where they go.
        labels: of the objects.
    """

    def __init__(self, lines: Lines, labels: Sequence[str]) -> None:
        self._lines, self._labels = lines, labels
        self._quaternions = torch.zeros(len(labels), 4, dtype=torch.float64)

    def add(self, step: Step) -> None:
        """Write one line per object."""
        self._quaternions = with_signs_of(quaternion_from_rotation(step.result.T_cam_obj[:, :3, :3].cpu()), self._quaternions)
        rows = [_pose_of(step.result, index, label, self._quaternions[index]) for index, label in enumerate(self._labels)]
        self._lines.write("".join(f"{json.dumps(finite(row), ensure_ascii=False, allow_nan=False)}\n" for row in rows))

    def close(self) -> None:
        """No more steps come."""
        self._lines.close()


def _pose_of(result: StepResult, index: int, label: str, quaternion_xyzw: Float[Tensor, "4"]) -> dict[str, Any]:
    """What a step says of one object, as JSON has it; the covariance has the order of :class:`StepResult`."""
    return {
        "t_us": int(result.t_us[0]),
        "label": label,
        "translation_m": result.T_cam_obj[index, :3, 3].tolist(),
        "quaternion_xyzw": quaternion_xyzw.tolist(),
        "covariance": [[float(f"{value:.6g}") for value in row] for row in result.covariance[index].tolist()],
        "status": Status(int(result.status[index])).name,
        "quality": float(f"{float(result.quality[index]):.4g}"),
        "observations": int(result.observation_count[index]),
    }
