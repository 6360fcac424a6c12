"""A finished run, read from its output folder alone."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from torchtrack.core.lie import rotation_from_quaternion
from torchtrack.errors import MissingFileError, UnknownFormatError
from torchtrack.run.sinks.folder import CONFIG, POSES, SUMMARY
from torchtrack.run.sinks.poses import COLUMNS
from torchtrack.tracking.validation.status import Status


@dataclass(frozen=True)
class ObjectTrack:
    """What ``poses.csv`` says of one object, a row per window.

    Args:
        label: of the object.
        t_us: ends of the windows.
        T_cam_obj: poses.
        status: :class:`torchtrack.tracking.validation.status.Status` of each.
        quality: of each.
        error: rotation (°) and translation (cm) against the truth; NaN where it is not known.
        std: standard deviations of rotation (°) and position (cm), as the tracker estimates them.
    """

    label: str
    t_us: Int[np.ndarray, "n"]
    T_cam_obj: Float[np.ndarray, "n 4 4"]
    status: Int[np.ndarray, "n"]
    quality: Float[np.ndarray, "n"]
    error: Float[np.ndarray, "n 2"]
    std: Float[np.ndarray, "n 2"]

    @property
    def position_m(self) -> Float[np.ndarray, "n 3"]:
        """Of the object's origin, in the camera's frame."""
        return self.T_cam_obj[:, :3, 3]

    def first(self, count: int) -> "ObjectTrack":
        """The first windows of it."""
        values = (self.t_us, self.T_cam_obj, self.status, self.quality, self.error, self.std)
        return ObjectTrack(self.label, *(value[:count] for value in values))


@dataclass(frozen=True)
class FinishedRun:
    """An output folder.

    Args:
        folder: its path.
        summary: ``summary.json``.
        config: text of ``config.yaml``.
        tracks: one per object.
    """

    folder: Path
    summary: Mapping[str, Any]
    config: str
    tracks: tuple[ObjectTrack, ...]

    @property
    def name(self) -> str:
        """What it is called beside others."""
        return self.folder.resolve().name

    @property
    def stills(self) -> tuple[Path, ...]:
        """Its stills, in the order of time."""
        return tuple(sorted(self.folder.glob("overlay*.png"), key=lambda path: (len(path.name), path.name)))

    @property
    def videos(self) -> tuple[Path, ...]:
        """Its videos; a run that was resumed has several."""
        return tuple(sorted(self.folder.glob("overlay*.mp4")))


def read_run(folder: Path) -> FinishedRun:
    """Read the output folder of a run.

    Raises:
        MissingFileError: if it is not there, or not of a run.
        UnknownFormatError: if its files are not what this version of torchtrack writes.
    """
    if missing := [name for name in (SUMMARY, CONFIG, POSES) if not (folder / name).is_file()]:
        raise MissingFileError(f"'{folder}' is no output folder of a run: {', '.join(missing)} is not there. Name a folder that `track` has written.")
    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        config = (folder / CONFIG).read_text(encoding="utf-8", errors="replace")
    except ValueError as error:
        raise UnknownFormatError(f"'{folder / SUMMARY}' cannot be read: {error}. Track again.") from error
    if not isinstance(summary, dict) or not {"source", "ended", "objects", "versions"} <= summary.keys():
        raise UnknownFormatError(f"'{folder / SUMMARY}' is no summary of a run. Track again.")
    return FinishedRun(folder, summary, config, _tracks(folder / POSES))


def _tracks(path: Path) -> tuple[ObjectTrack, ...]:
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        # A run that was killed may have left a line that is not whole.
        header, *rows = [*csv.reader(line for line in file if line.endswith("\n"))] or [[]]
    if tuple(header) != COLUMNS:
        raise UnknownFormatError(f"'{path}' is no table of poses that this version of torchtrack writes. Track again.")
    labels = dict.fromkeys(row[1] for row in rows if len(row) > 1)
    try:
        return tuple(_track(label, [row for row in rows if row[1] == label]) for label in labels)
    except (ValueError, KeyError, IndexError) as error:
        raise UnknownFormatError(f"'{path}' holds something else than poses: {error}. Track again.") from error


def _track(label: str, rows: Sequence[Sequence[str]]) -> ObjectTrack:
    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[COLUMNS.index(name)] or "nan") for name in names] for row in rows])

    return ObjectTrack(
        label=label,
        t_us=np.array([int(row[0]) for row in rows], dtype=np.int64),
        T_cam_obj=_poses(columns("tx", "ty", "tz"), columns("qx", "qy", "qz", "qw")),
        status=np.array([int(Status[row[COLUMNS.index("status")]]) for row in rows], dtype=np.int64),
        quality=columns("quality")[:, 0],
        error=columns("rotation_error_deg", "translation_error_cm"),
        std=columns("rotation_std_deg", "translation_std_cm"),
    )


def _poses(position_m: Float[np.ndarray, "n 3"], quaternion: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4 4"]:
    poses = np.tile(np.eye(4), (len(position_m), 1, 1))
    poses[:, :3, :3] = rotation_from_quaternion(torch.from_numpy(quaternion)).numpy()
    poses[:, :3, 3] = position_m
    return poses
