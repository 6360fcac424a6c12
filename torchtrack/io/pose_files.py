"""Poses as others write them: TUM, CSV, BOP and OptiTrack; :func:`read_trajectory` tells them apart by content.

A tracker wants ``T_cam_obj``. A motion capture system knows poses in a world of its own: give ``T_cam_world``, and the poses
become ``T_cam_world @ T_world_obj``.
"""

import csv
import json
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.events import TimeUnit
from torchtrack.errors import PoseError, TorchtrackWarning
from torchtrack.io.pose_times import pose_times_us
from torchtrack.io.trajectory import Trajectory, check_lines, read_tum, trajectory_of
from torchtrack.io.whole_text import read_text_file, shown

_POSITION, _QUATERNION = ("tx", "ty", "tz"), ("qx", "qy", "qz", "qw")
_TIMES = ("t_us", "time_us", "t_ms", "time_ms", "t_ns", "time_ns", "t_s", "time_s", "t", "time", "timestamp", "timestamp_us", "timestamp_ns")
_UNITS: dict[str, TimeUnit] = {"s": "s", "ms": "ms", "us": "us", "ns": "ns"}
_OTHER_NAMES = {"x": "tx", "y": "ty", "z": "tz", "px": "tx", "py": "ty", "pz": "tz", "q_x": "qx", "q_y": "qy", "q_z": "qz", "q_w": "qw"}
_METRES = {"meters": 1.0, "metres": 1.0, "m": 1.0, "millimeters": 1e-3, "millimetres": 1e-3, "mm": 1e-3, "centimeters": 1e-2, "cm": 1e-2}


@dataclass(frozen=True)
class _Wanted:
    """What is said beside a file: which object, the time between images (µs), and the unit of its times."""

    name: str | None
    frame_us: int | None
    time_unit: TimeUnit | None


def read_trajectory(
    path: str | os.PathLike[str],
    *,
    name: str | None = None,
    frame_us: int | None = None,
    T_cam_world: Float[Tensor, "4 4"] | None = None,
    time_unit: TimeUnit | None = None,
) -> Trajectory:
    """The poses of one object over time.

    - TUM: lines ``t tx ty tz qx qy qz qw``, seconds and metres.
    - CSV: a first line that names ``t`` (seconds) or ``t_us`` (``_ms``, ``_ns``), ``tx ty tz`` (metres; also ``x y z``) and ``qx qy qz qw``.
    - BOP (``scene_gt.json``): per image the poses ``cam_R_m2c`` and ``cam_t_m2c`` (mm); ``frame_us`` says how far images lie apart.
    - OptiTrack (CSV of Motive): a rigid body with quaternions; times in seconds.

    Warns (:class:`~torchtrack.errors.TorchtrackWarning`) where one of several objects is taken.

    Args:
        path: the file.
        name: which object: of BOP its ``obj_id``, of OptiTrack its rigid body; the first one by default.
        frame_us: time from one image to the next (µs), for BOP.
        T_cam_world: where the camera is, for poses in a world frame.
        time_unit: of the times of TUM and CSV, where the file does not say it; seconds by default.

    Raises:
        MissingFileError: if there is no such file.
        LimitError: if it is larger than ``limits.pose_file_bytes``, or has more than ``limits.poses``.
        PoseError: if it is none of these, something is missing, or the poses or times make no sense.
    """
    path = Path(path)
    text = read_text_file(path, "trajectory file", "pose_file_bytes", PoseError)
    if not text.lstrip().startswith("{"):
        check_lines(text, path)
    wanted = _Wanted(name, frame_us, time_unit)
    try:
        if text.lstrip().startswith("{"):
            read = _read_bop(text, wanted)
        elif text.startswith("Format Version"):
            read = _read_optitrack(text, wanted)
        elif "," in next((line for line in text.splitlines() if line.strip() and not _is_comment(line)), ""):
            read = _read_csv(text, wanted)
        else:
            return _in_camera(read_tum(path, time_unit), T_cam_world)
    except PoseError as error:
        raise PoseError(f"'{path}': {shown(error)}") from error
    return _in_camera(read, T_cam_world)


def _is_comment(line: str) -> bool:
    """Whether a line is one; EuRoC's first line, which names the columns, is none."""
    return line.startswith("#") and line.count(",") < 7


def _in_camera(trajectory: Trajectory, T_cam_world: Tensor | None) -> Trajectory:
    return trajectory if T_cam_world is None else Trajectory(trajectory.t_us, T_cam_world.to(torch.float64) @ trajectory.T_cam_obj)


def _rows_of(text: str) -> list[list[str]]:
    try:
        return list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise PoseError(f"it is not CSV ({error}).") from error


def _read_csv(text: str, wanted: _Wanted) -> Trajectory:
    lines = [line for line in text.splitlines() if not _is_comment(line)]
    rows = [row for row in _rows_of("\n".join(lines)) if "".join(row).strip()]
    headings = [word.strip().lower().lstrip("# ") for word in rows[0]] if rows else []
    names = [_column_name(heading) for heading in headings]
    time = next((name for name in names if name in _TIMES), None)
    missing = [word for word in (*_POSITION, *_QUATERNION) if word not in names]
    if time is None or missing:
        raise PoseError(f"the first line must name t or t_us, tx, ty, tz, qx, qy, qz and qw; it names {', '.join(names)[:300]}.")
    several = sorted({word for word in (time, *_POSITION, *_QUATERNION) if names.count(word) > 1})
    if several:
        raise PoseError(f"the first line names {', '.join(several)} more than once. Keep the columns of one object.")
    scale = _length_m(headings[names.index("tx")])
    times, poses = [], []
    for number, row in enumerate(rows[1:], start=2):
        try:
            values = dict(zip(names, row, strict=True))
            times.append(values[time])
            poses.append([scale * float(values[word]) for word in _POSITION] + [float(values[word]) for word in _QUATERNION])
        except ValueError as error:
            raise PoseError(f"line {number} cannot be read: {error}.") from error
    return trajectory_of(pose_times_us(times, wanted.time_unit or _unit_in_heading(headings[names.index(time)])), poses)


def _column_name(heading: str) -> str:
    """Our name of a column: without a unit in brackets, and without EuRoC's frames."""
    bare = heading.partition("[")[0].strip().removeprefix("p_rs_r_").removeprefix("p_").removeprefix("q_rs_").removeprefix("q_")
    return _OTHER_NAMES.get(bare, bare) if heading[:2] != "q_" else f"q{bare}"


def _unit_in_heading(heading: str) -> TimeUnit | None:
    """The unit that the name of a column of times says: ``t_us``, or ``timestamp [ns]``."""
    word = heading.replace("[", "_").replace("]", "").replace(" ", "").rpartition("_")[2]
    return _UNITS.get(word)


def _length_m(heading: str) -> float:
    """The unit of positions, by what stands in brackets."""
    word = heading.partition("[")[2].rstrip("] ").strip() or "m"
    if word not in _METRES:
        raise PoseError(f"the unit '{word}' is not known; known are {', '.join(_METRES)}.")
    return _METRES[word]


def _read_bop(text: str, wanted: _Wanted) -> Trajectory:
    if wanted.frame_us is None:
        raise PoseError("BOP numbers its images and does not say their times. Give frame_us, the time from one to the next (µs).")
    try:
        scene: dict[str, list[dict[str, Any]]] = json.loads(text)
        of_images = sorted(((int(image), entries) for image, entries in scene.items()), key=lambda item: item[0])
        ids = list(dict.fromkeys(str(entry["obj_id"]) for _, entries in of_images for entry in entries))
        chosen = _one_of(ids, wanted.name, "obj_id")
        timed_entries = [(image * wanted.frame_us, entry) for image, entries in of_images for entry in entries if str(entry["obj_id"]) == chosen]
        T = np.tile(np.eye(4), (len(timed_entries), 1, 1))
        for pose, (_, entry) in zip(T, timed_entries, strict=True):
            pose[:3, :3] = np.reshape(entry["cam_R_m2c"], (3, 3))
            pose[:3, 3] = 1e-3 * np.asarray(entry["cam_t_m2c"], np.float64)
        t_us = np.array([time for time, _ in timed_entries], np.int64)
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        if isinstance(error, PoseError):
            raise
        raise PoseError(f"this is not the scene_gt.json of BOP ({type(error).__name__}: {str(error)[:200]}).") from error
    return Trajectory(torch.from_numpy(t_us), torch.from_numpy(T))


def _one_of(names: list[str], wanted: str | None, kind: str) -> str:
    """The wanted one of several names, or the first, which is told.

    Raises:
        PoseError: if there is none like it.
    """
    listed = ", ".join(names)[:500]
    if not names or (wanted is not None and wanted not in names):
        raise PoseError(f"there is no {kind} '{wanted}'. Those there are: {listed or 'none'}.")
    if wanted is None and len(names) > 1:
        warnings.warn(f"{len(names)} of {kind}: {listed}. '{names[0]}' is taken; name (initial_pose.name) chooses another.", TorchtrackWarning, 2)
    return names[0] if wanted is None else wanted


def _read_optitrack(text: str, wanted: _Wanted) -> Trajectory:
    rows = _rows_of(text)
    header = dict(zip(rows[0][0::2], rows[0][1::2], strict=False))
    start = next((index for index, row in enumerate(rows) if row[:1] == ["Frame"]), None)
    if start is None or start < 4:
        raise PoseError("the export of Motive has no line 'Frame, Time (Seconds), …'. Export it as CSV with its header.")
    if header.get("Rotation Type", "Quaternion") != "Quaternion":
        raise PoseError(f"rotations are of type {header['Rotation Type']}. Export them as Quaternion.")
    columns = _body_columns(rows[:start], rows[start], wanted.name)
    unit = header.get("Length Units", "Meters").lower()
    if unit not in _METRES:
        raise PoseError(f"the unit '{unit}' is not known; known are {', '.join(_METRES)}.")
    times, poses = [], []
    for row in rows[start + 1 :]:
        words = [row[column] if column < len(row) else "" for column in columns]
        # A body that the cameras lost has no numbers.
        if len(row) > 1 and all(words):
            try:
                poses.append([_METRES[unit] * float(word) for word in words[4:]] + [float(word) for word in words[:4]])
                float(row[1])
            except ValueError as error:
                raise PoseError(f"frame {row[0]} cannot be read: {error}.") from error
            times.append(row[1])
    return trajectory_of(pose_times_us(times, wanted.time_unit or "s"), poses)


def _body_columns(header: list[list[str]], axes: list[str], name: str | None) -> list[int]:
    """Columns of a rigid body's ``qx qy qz qw x y z``."""
    width = len(axes)
    padded = [row + [""] * (width - len(row)) for row in header]
    types = next((row for row in padded if "Rigid Body" in row), None)
    kinds = next((row for row in padded if "Rotation" in row and "Position" in row), None)
    if types is None or kinds is None:
        raise PoseError("the export of Motive has no rigid body. Export rigid bodies.")
    names = padded[padded.index(types) + 1]
    bodies = list(dict.fromkeys(names[column] for column in range(width) if types[column] == "Rigid Body"))
    chosen = _one_of(bodies, name, "rigid body")
    columns = [
        next((c for c in range(width) if types[c] == "Rigid Body" and names[c] == chosen and kinds[c] == kind and axes[c] == axis), None)
        for kind, of_kind in (("Rotation", "XYZW"), ("Position", "XYZ"))
        for axis in of_kind
    ]
    known = [column for column in columns if column is not None]
    if len(known) != len(columns):
        raise PoseError(f"there is no rigid body '{chosen}' with rotation and position. Those there are: {', '.join(bodies)}.")
    return known
