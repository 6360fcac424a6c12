"""Poses as text while a run goes on: one TUM trajectory per object, and one table of everything."""

import csv
import io
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.lie import quaternion_from_rotation, with_signs_of
from torchtrack.core.pose_covariance import origin_covariance
from torchtrack.io.line_file import LineFile
from torchtrack.io.seconds import format_seconds
from torchtrack.run.sinks.folder import POSES
from torchtrack.run.sinks.record import Record
from torchtrack.run.stepping import Step
from torchtrack.tracking.validation.status import Status

COLUMNS = (
    *("t_us", "label", "tx", "ty", "tz", "qx", "qy", "qz", "qw"),
    *("status", "quality", "observations", "rotation_error_deg", "translation_error_cm"),
    *("rotation_std_deg", "translation_std_cm"),
)


class PoseFiles:
    """Writes ``trajectory_LABEL.tum`` and ``poses.csv`` into a folder, row by row; each row is on disk when its step is taken.

    Files that are there already are written on. No quaternion has another sign than the one before it. Errors are left empty where there is no truth.

    Raises:
        OutputError: if they cannot be written; the files end with a whole line then.
    """

    def __init__(self, folder: Path, labels: Sequence[str], record: Record) -> None:
        """``record`` has taken a step before this sink does: the errors come from there."""
        self._labels, self._record = labels, record
        with ExitStack() as opening:

            def begun(path: Path, header: str) -> LineFile:
                file = opening.enter_context(closing(LineFile(path)))
                if path.stat().st_size == 0:
                    file.write(header)
                return file

            self._table = begun(folder / POSES, _rows([COLUMNS]))
            self._tum = [begun(tum_path(folder, label), "# t tx ty tz qx qy qz qw (seconds, metres)\n") for label in labels]
            self._quaternions = torch.stack([_last_quaternion(tum_path(folder, label)) for label in labels])
            self._files = opening.pop_all()

    def add(self, step: Step) -> None:
        """Write one row per object."""
        result = step.result
        t_us = int(result.t_us[0])
        T = result.T_cam_obj.cpu()
        self._quaternions = with_signs_of(quaternion_from_rotation(T[:, :3, :3]), self._quaternions)
        quaternions = self._quaternions.tolist()
        judged = zip(result.status.tolist(), result.quality.tolist(), result.observation_count.tolist(), strict=True)
        columns = zip(self._labels, T[:, :3, 3].tolist(), quaternions, judged, strict=True)
        stds = standard_deviations(result.covariance.cpu(), T).tolist()
        rows: list[Sequence[object]] = []
        for index, (label, translation, quaternion, (status, quality, count)) in enumerate(columns):
            pose = [f"{value:.12g}" for value in (*translation, *quaternion)]
            self._tum[index].write(f"{format_seconds(t_us)} {' '.join(pose)}\n")
            errors = [f"{value:.6g}" for value in self._record.newest_errors(index)]
            rows.append(
                [t_us, label, *pose, Status(status).name, f"{quality:.4g}", count, *(errors or ("", "")), *(f"{value:.4g}" for value in stds[index])]
            )
        self._table.write(_rows(rows))

    def close(self) -> None:
        """Close the files."""
        self._files.close()


def standard_deviations(covariance: Float[Tensor, "b 6 6"], T_cam_obj: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b 2"]:
    """Standard deviations of rotation (°) and position (cm) of the object's origin, each over all three axes.

    Args:
        covariance: of the left perturbation ``[φ, ρ]``.
        T_cam_obj: the poses.
    """
    variances = origin_covariance(covariance.to(T_cam_obj.dtype), T_cam_obj).diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, 3)).sum(-1)
    rotation, position = variances.clamp(min=0).sqrt().unbind(-1)
    return torch.stack([rotation.rad2deg(), 100 * position], -1)


def tum_path(folder: Path, label: str) -> Path:
    """Where the trajectory of an object is."""
    return folder / f"trajectory_{label}.tum"


def _last_quaternion(path: Path) -> Float[Tensor, "4"]:
    """The last one of a trajectory, or zeros where there is none: a zero has either sign."""
    *_, last = path.read_text(encoding="utf-8").splitlines() or [""]
    numbers = [] if last.startswith("#") else [float(word) for word in last.split()[4:]]
    return torch.tensor(numbers or [0.0] * 4, dtype=torch.float64)


def _rows(rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue()
