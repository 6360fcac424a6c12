"""Poses over time: interpolation on SE(3), and TUM text files as evo reads and writes them."""

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.events import TimeUnit
from torchtrack.core.atomic import atomic_path
from torchtrack.core.lie import (
    continuous_quaternions,
    quaternion_from_rotation,
    rotation_angle_deg,
    rotation_from_quaternion,
    se3_interpolate,
)
from torchtrack.core.limits import check_limit
from torchtrack.core.pose_checks import check_pose, quaternion_problem
from torchtrack.errors import PoseError
from torchtrack.io.pose_times import pose_times_us
from torchtrack.io.seconds import format_seconds
from torchtrack.io.whole_text import read_text_file

# Between poses further apart than this in time, what moves may have gone any way. At rest is what moves by less than a measurement errs.
_LONGEST_GAP_US = 500_000
_AT_REST_DEG, _AT_REST_M = 1.0, 0.005
# And where an object has turned further than this between two poses that are so far apart, it may have turned the other way round.
_LARGEST_TURN_DEG, _TURN_US = 90.0, 20_000
# Beyond its ends a trajectory holds for its usual interval, and no longer than this.
_LONGEST_SLACK_US = 100_000
# A file may have so many lines more than poses: comments, names of columns.
_LINES_OF_HEADER = 1000


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

    @cached_property
    def gaps(self) -> Bool[Tensor, "g"]:
        """Between which neighbours nobody knows how the object went: half a second and more in motion, or a turn of over 90° in 20 ms and more."""
        before, after = self.T_cam_obj[:-1], self.T_cam_obj[1:]
        turned_deg = rotation_angle_deg(before[:, :3, :3], after[:, :3, :3])
        moves = (turned_deg > _AT_REST_DEG) | ((after - before)[:, :3, 3].norm(dim=-1) > _AT_REST_M)
        apart_us = torch.diff(self.t_us)
        return (moves & (apart_us > _LONGEST_GAP_US)) | ((turned_deg > _LARGEST_TURN_DEG) & (apart_us > _TURN_US))

    def covers(self, t_us: Int[Tensor, "q"]) -> Bool[Tensor, "q"]:
        """Which times lie between its ends, and within no gap (:attr:`gaps`)."""
        t_us = t_us.to(self.t_us)
        within = (t_us >= self.t_us[0]) & (t_us <= self.t_us[-1])
        if not bool(self.gaps.any()):
            return within
        after = torch.searchsorted(self.t_us, t_us).clamp(1, len(self) - 1)
        return within & (~self.gaps[after - 1] | (t_us == self.t_us[after]) | (t_us == self.t_us[after - 1]))

    def measured_at(self, t_us: int, name: str) -> Float[Tensor, "4 4"]:
        """The pose at a time that it covers, or that its ends are nearer to than poses usually are to one another.

        Args:
            t_us: the time.
            name: what the trajectory is called, for messages.

        Raises:
            PoseError: if nothing was measured then.
        """
        time = torch.tensor([t_us])
        usual_us = int(torch.diff(self.t_us).median()) if len(self) > 1 else _LONGEST_SLACK_US
        slack_us = min(usual_us, _LONGEST_SLACK_US)
        first, last = int(self.t_us[0]), int(self.t_us[-1])
        if not first - slack_us <= t_us <= last + slack_us:
            raise PoseError(
                f"{name} covers {format_seconds(first)} s to {format_seconds(last)} s, but the start is at {format_seconds(t_us)} s (start_us). "
                "Is it on another clock, or in another unit? Shift its times, or start within it."
            )
        if first <= t_us <= last and not bool(self.covers(time)):
            at = int(torch.searchsorted(self.t_us, time)[0])
            before, after = format_seconds(int(self.t_us[at - 1])), format_seconds(int(self.t_us[at]))
            raise PoseError(
                f"{name} has a gap from {before} s to {after} s, and the start at {format_seconds(t_us)} s (start_us) lies in it: what lies between "
                "two poses so far apart is not known. Start at a time that was measured."
            )
        return self.at(time)[0]

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


def read_tum(path: str | os.PathLike[str], time_unit: TimeUnit | None = None) -> Trajectory:
    """A trajectory from a TUM file: lines ``t tx ty tz qx qy qz qw``, seconds and metres; ``#`` starts a comment.

    Args:
        path: the file.
        time_unit: of its times, where they are no seconds.

    Raises:
        MissingFileError: if there is no such file.
        LimitError: if it is larger than ``limits.pose_file_bytes``, or has more than ``limits.poses``.
        PoseError: if a line cannot be read, with its number and content, or its times cannot be seconds.
    """
    path = Path(path)
    text = read_text_file(path, "trajectory file", "pose_file_bytes", PoseError)
    check_lines(text, path)
    times: list[str] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.partition("#")[0].split()
        if content:
            times.append(content[0])
            rows.append(_parse_tum_line(content, f"{path}, line {number}"))
    if not rows:
        raise PoseError(f"trajectory file '{path}' holds no pose; expected lines 't tx ty tz qx qy qz qw'.")
    try:
        return trajectory_of(pose_times_us(times, time_unit), rows)
    except PoseError as error:
        raise PoseError(f"{path}: {error}") from error


def check_lines(text: str, path: Path) -> None:
    """Refuse a file of more lines than poses are read, before any of them is.

    Raises:
        LimitError: if it has more.
    """
    check_limit("poses", max(text.count("\n") - _LINES_OF_HEADER, 0), path)


def trajectory_of(t_us: list[int], rows: list[list[float]]) -> Trajectory:
    """A trajectory of times (µs) and rows ``tx ty tz qx qy qz qw``.

    Raises:
        LimitError: if there are more poses than ``limits.poses``.
        PoseError: as :class:`Trajectory`, or if a quaternion has not the norm 1.
    """
    check_limit("poses", len(rows), "the file of poses")
    values = torch.tensor(rows, dtype=torch.float64).reshape(-1, 7)
    norms = values[:, 3:].norm(dim=-1)
    worst = int((norms - 1).abs().nan_to_num(torch.inf).argmax()) if len(rows) else 0
    if rows and (problem := quaternion_problem(rows[worst][3:])) is not None:
        raise PoseError(f"pose {worst}: {problem}")
    T = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    T[:, :3, :3] = rotation_from_quaternion(values[:, 3:])
    T[:, :3, 3] = values[:, :3]
    return Trajectory(torch.tensor(t_us, dtype=torch.int64), T)


def _parse_tum_line(content: list[str], where: str) -> list[float]:
    """``tx ty tz qx qy qz qw`` of one line."""
    expected = f"{where}: expected 't tx ty tz qx qy qz qw' (8 numbers), got '{' '.join(content)[:200]}'"
    if len(content) != 8:
        raise PoseError(f"{expected}.")
    try:
        # Of the time all digits are taken, once its unit is settled.
        row = [float(value) for value in content]
    except ValueError as error:
        raise PoseError(f"{expected}: {error}.") from error
    if (problem := quaternion_problem(row[4:])) is not None:
        raise PoseError(f"{where}: {problem}")
    return row[1:]


def write_tum(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write a trajectory as TUM text, times exact to the microsecond, quaternions without a jump of sign; the file appears whole or not at all."""
    T = trajectory.T_cam_obj.cpu()
    values = torch.cat([T[:, :3, 3], continuous_quaternions(quaternion_from_rotation(T[:, :3, :3]))], -1).tolist()
    lines = [
        f"{format_seconds(t_us)} {' '.join(f'{value:.12g}' for value in row)}\n" for t_us, row in zip(trajectory.t_us.tolist(), values, strict=True)
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("# t tx ty tz qx qy qz qw (seconds, metres)\n" + "".join(lines), encoding="utf-8")
