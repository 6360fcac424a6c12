"""Poses over time: interpolation on SE(3), and TUM text files as evo reads and writes them."""

import os
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.errors import MissingFileError, PoseError
from torchtrack.io.atomic import atomic_path
from torchtrack.io.seconds import format_seconds, parse_seconds
from torchtrack.lie import check_pose, quaternion_from_rotation, rotation_from_quaternion, se3_interpolate

# Text files round their quaternions; a norm further from 1 than this means other numbers in these columns.
_QUATERNION_TOLERANCE = 0.01


@dataclass(frozen=True)
class Trajectory:
    """Poses of one object at strictly increasing times.

    Args:
        t_us: ``[p]`` int64, microseconds.
        T_cam_obj: ``[p, 4, 4]`` float64, metres.

    Raises:
        PoseError: if shapes disagree, there is no pose, times do not increase, or a matrix is not a rigid motion.
    """

    # Shapes and types are checked below: what a file holds must fail as a PoseError.
    t_us: Tensor
    T_cam_obj: Tensor

    def __post_init__(self) -> None:
        if self.t_us.dtype.is_floating_point:
            raise PoseError(f"trajectory times must be integer microseconds, got {self.t_us.dtype}. Multiply seconds by 1e6 and round.")
        object.__setattr__(self, "t_us", self.t_us.to(torch.int64))
        object.__setattr__(self, "T_cam_obj", self.T_cam_obj.to(torch.float64))
        if self.t_us.ndim != 1 or self.T_cam_obj.shape != (len(self.t_us), 4, 4):
            raise PoseError(f"a trajectory needs times [p] and poses [p, 4, 4], got {list(self.t_us.shape)} and {list(self.T_cam_obj.shape)}.")
        if len(self.t_us) == 0:
            raise PoseError("a trajectory needs at least one pose, got none.")
        check_pose(self.T_cam_obj)
        _check_increasing(self.t_us)

    def __len__(self) -> int:
        return len(self.t_us)

    def at(self, t_us: Int[Tensor, "q"]) -> Float[Tensor, "q 4 4"]:
        """Poses at the integer times ``t_us`` (µs), moving with constant twist between neighbours, at rest beyond the ends."""
        if t_us.dtype.is_floating_point:
            raise PoseError(f"times to interpolate at must be integer microseconds, got {t_us.dtype}.")
        t_us = t_us.to(self.t_us)
        if len(self) == 1:
            return self.T_cam_obj.expand(len(t_us), 4, 4).clone()
        after = torch.searchsorted(self.t_us, t_us).clamp(1, len(self) - 1)
        start_us, end_us = self.t_us[after - 1], self.t_us[after]
        # Integer differences first: absolute times have too many digits for a fraction.
        fraction = (t_us.clamp(start_us, end_us) - start_us).double() / (end_us - start_us).double()
        return se3_interpolate(self.T_cam_obj[after - 1], self.T_cam_obj[after], fraction)


def _check_increasing(t_us: Tensor) -> None:
    wrong = torch.nonzero(torch.diff(t_us) <= 0)
    if len(wrong):
        at = int(wrong[0])
        before, after = t_us[at : at + 2].tolist()
        raise PoseError(f"trajectory times must increase strictly, but pose {at + 1} is at {after} µs after {before} µs. Sort them, drop doubles.")


def read_tum(path: str | os.PathLike[str]) -> Trajectory:
    """A trajectory from a TUM file: lines ``t tx ty tz qx qy qz qw``, seconds and metres; ``#`` starts a comment.

    Raises:
        MissingFileError: if there is no such file.
        PoseError: if a line cannot be read, with its number and content.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"trajectory file '{path}' does not exist.")
    times: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        content = line.partition("#")[0].split()
        if content:
            t_us, row = _parse_tum_line(content, f"{path}, line {number}")
            times.append(t_us)
            rows.append(row)
    if not rows:
        raise PoseError(f"trajectory file '{path}' holds no pose; expected lines 't tx ty tz qx qy qz qw'.")
    values = torch.tensor(rows, dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    T[:, :3, :3] = rotation_from_quaternion(values[:, 3:])
    T[:, :3, 3] = values[:, :3]
    try:
        return Trajectory(torch.tensor(times, dtype=torch.int64), T)
    except PoseError as error:
        raise PoseError(f"{path}: {error}") from error


def _parse_tum_line(content: list[str], where: str) -> tuple[int, list[float]]:
    """Time (µs) and ``tx ty tz qx qy qz qw`` of one line."""
    expected = f"{where}: expected 't tx ty tz qx qy qz qw' (8 numbers), got '{' '.join(content)}'"
    if len(content) != 8:
        raise PoseError(f"{expected}.")
    try:
        t_us, row = parse_seconds(content[0]), [float(value) for value in content[1:]]
    except ValueError as error:
        raise PoseError(f"{expected}: {error}.") from error
    norm = sum(value * value for value in row[3:]) ** 0.5
    # Written so that NaN fails too.
    if not abs(norm - 1) <= _QUATERNION_TOLERANCE:
        raise PoseError(f"{where}: the quaternion qx qy qz qw has norm {norm:.4g}, expected 1. Check the order of the columns.")
    return t_us, row


def write_tum(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write a trajectory as TUM text, times exact to the microsecond; the file appears whole or not at all."""
    T = trajectory.T_cam_obj.cpu()
    values = torch.cat([T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3])], -1).tolist()
    lines = [
        f"{format_seconds(t_us)} {' '.join(f'{value:.12g}' for value in row)}\n" for t_us, row in zip(trajectory.t_us.tolist(), values, strict=True)
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("# t tx ty tz qx qy qz qw (seconds, metres)\n" + "".join(lines), encoding="utf-8")
