"""What is remembered of a run: a few numbers per window, for its summary."""

from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.core.lie import so3_log
from torchtrack.io import Trajectory
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.symmetry import RevolutionAxis, revolution_axis
from torchtrack.run.metrics import PoseErrors, pose_errors
from torchtrack.run.sinks.silences import Silences
from torchtrack.run.sinks.start_support import StartSupport
from torchtrack.run.stepping import Step
from torchtrack.tracking.validation.status import Status


@dataclass(frozen=True)
class Earlier:
    """The windows that a run has written before it ended early.

    Args:
        t_us: ``[n]``, ends of the windows.
        T_cam_obj: poses of all objects.
        status: :class:`torchtrack.tracking.validation.status.Status` of each.
        quality: of each.
    """

    t_us: Int[Tensor, "n"]
    T_cam_obj: Float[Tensor, "n b 4 4"]
    status: Int[Tensor, "n b"]
    quality: Float[Tensor, "n b"]


class ObjectRecord:
    """Status counts, qualities, the rotation so far, and the errors of one object."""

    def __init__(self, truth: Trajectory | None, axis: RevolutionAxis | None = None) -> None:
        """``truth`` is None where it is not known, ``axis`` where a turn about any shows."""
        self.truth, self.axis = truth, axis
        self.statuses: Counter[int] = Counter()
        # Of windows with too few events nothing is known.
        self.quality_sum, self.judged_windows = 0.0, 0
        self.start = StartSupport()
        # Sum of the rotations between windows (rad, camera axes): full turns count.
        self.turned = torch.zeros(3, dtype=torch.float64)
        self._last_rotation: Tensor | None = None
        self._t_us, self._rotation_deg, self._translation_cm = array("q"), array("d"), array("d")
        self._newest: tuple[float, ...] = ()

    def add(self, t_us: Tensor, T_cam_obj: Tensor, status: int, quality: float) -> None:
        """Take one window: time ``[1]``, pose ``[4, 4]``."""
        self.statuses[status] += 1
        self.start.add(status, quality)
        if status != Status.TOO_FEW_EVENTS:
            self.quality_sum, self.judged_windows = self.quality_sum + quality, self.judged_windows + 1
        rotation = T_cam_obj[:3, :3]
        if self._last_rotation is not None:
            self.turned = self.turned + so3_log(rotation @ self._last_rotation.T)
        self._last_rotation = rotation
        self._newest = ()
        if self.truth is not None:
            self._add_errors(pose_errors(t_us, T_cam_obj[None], self.truth, self.axis))

    def add_many(self, t_us: Tensor, T_cam_obj: Tensor, statuses: Sequence[int], qualities: Sequence[float]) -> None:
        """Take the windows of an earlier part of the run, before any other: times ``[n]``, poses ``[n, 4, 4]``."""
        if not len(t_us):
            return
        self.statuses.update(statuses)
        for status, quality in zip(statuses, qualities, strict=True):
            self.start.add(status, quality)
        judged = [quality for status, quality in zip(statuses, qualities, strict=True) if status != Status.TOO_FEW_EVENTS]
        self.quality_sum, self.judged_windows = self.quality_sum + sum(judged), self.judged_windows + len(judged)
        rotations = T_cam_obj[:, :3, :3]
        self.turned = self.turned + so3_log(rotations[1:] @ rotations[:-1].mT).sum(0)
        self._last_rotation = rotations[-1]
        if self.truth is not None:
            self._add_errors(pose_errors(t_us, T_cam_obj, self.truth, self.axis))

    def _add_errors(self, errors: PoseErrors) -> None:
        for t_us, rotation, translation in zip(errors.t_us.tolist(), errors.rotation_deg.tolist(), errors.translation_cm.tolist(), strict=True):
            self._t_us.append(t_us)
            self._rotation_deg.append(rotation)
            self._translation_cm.append(translation)
            self._newest = (rotation, translation)

    @property
    def newest_errors(self) -> tuple[float, ...]:
        """δR (°) and δT (cm) of the newest window; empty where there is no truth for it."""
        return self._newest

    @property
    def errors(self) -> PoseErrors | None:
        """The errors of all windows; None where the truth is not known."""
        if self.truth is None:
            return None
        return PoseErrors(
            torch.tensor(self._t_us, dtype=torch.int64),
            torch.tensor(self._rotation_deg, dtype=torch.float64),
            torch.tensor(self._translation_cm, dtype=torch.float64),
        )


class Record:
    """The sink that everything in a summary comes from."""

    def __init__(self, truth: Sequence[Trajectory | None], models: Sequence[ObjectModel]) -> None:
        """``truth`` and ``models`` have one entry per object."""
        axes = [revolution_axis(model) if of_object is not None else None for model, of_object in zip(models, truth, strict=True)]
        self.objects = [ObjectRecord(*of_object) for of_object in zip(truth, axes, strict=True)]
        self.step_seconds = array("d")
        self.event_count = 0
        self.silences = Silences()
        self._duration_us = 0
        self.windows = 0
        # Stream time of an earlier part of the run (s), of which neither events nor step times are known.
        self.earlier_s = 0.0

    def resume(self, earlier: Earlier, start_us: int) -> None:
        """Take what an earlier part of the run has written; ``start_us``: where that began."""
        if not len(earlier.t_us):
            return
        self.windows = len(earlier.t_us)
        self._duration_us = int(earlier.t_us[-1]) - start_us
        self.earlier_s = self.duration_s
        for index, of_object in enumerate(self.objects):
            T, status, quality = earlier.T_cam_obj[:, index], earlier.status[:, index], earlier.quality[:, index]
            of_object.add_many(earlier.t_us, T, status.tolist(), quality.tolist())

    def add(self, step: Step) -> None:
        """Take one step."""
        result = step.result
        self.windows += 1
        self.step_seconds.append(step.seconds)
        self.event_count += len(step.window.events)
        self.silences.add(step)
        self._duration_us += step.window.t_end_us - step.window.t_start_us
        t_us, T = result.t_us[:1].cpu(), result.T_cam_obj.cpu()
        for index, (status, quality) in enumerate(zip(result.status.tolist(), result.quality.tolist(), strict=True)):
            self.objects[index].add(t_us, T[index], status, quality)

    def newest_errors(self, index: int) -> tuple[float, ...]:
        """δR (°) and δT (cm) of an object in the newest window; empty where there is no truth for it."""
        return self.objects[index].newest_errors

    def close(self) -> None:
        """Nothing is open."""

    @property
    def duration_s(self) -> float:
        """Stream time that was tracked, without what was passed over."""
        return 1e-6 * self._duration_us
