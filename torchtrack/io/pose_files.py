"""Poses as others write them: TUM, CSV, BOP and OptiTrack; :func:`read_trajectory` tells them apart by content.

A tracker wants ``T_cam_obj``. A motion capture system knows poses in a world of its own: give ``T_cam_world``, and the poses
become ``T_cam_world @ T_world_obj``.
"""

import csv
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.errors import MissingFileError, PoseError
from torchtrack.io.seconds import parse_seconds
from torchtrack.io.trajectory import Trajectory, read_tum
from torchtrack.lie import rotation_from_quaternion

_POSITION, _QUATERNION = ("tx", "ty", "tz"), ("qx", "qy", "qz", "qw")
_OTHER_NAMES = {"x": "tx", "y": "ty", "z": "tz", "px": "tx", "py": "ty", "pz": "tz", "q_x": "qx", "q_y": "qy", "q_z": "qz", "q_w": "qw"}
_METRES = {"meters": 1.0, "metres": 1.0, "m": 1.0, "millimeters": 1e-3, "millimetres": 1e-3, "mm": 1e-3, "centimeters": 1e-2, "cm": 1e-2}


def read_trajectory(
    path: str | os.PathLike[str],
    *,
    name: str | None = None,
    frame_us: int | None = None,
    T_cam_world: Float[Tensor, "4 4"] | None = None,
) -> Trajectory:
    """The poses of one object over time.

    - TUM: lines ``t tx ty tz qx qy qz qw``, seconds and metres.
    - CSV: a first line that names ``t`` (seconds) or ``t_us``, ``tx ty tz`` (metres; also ``x y z``) and ``qx qy qz qw``.
    - BOP (``scene_gt.json``): per image the poses ``cam_R_m2c`` and ``cam_t_m2c`` (mm); ``frame_us`` says how far images lie apart.
    - OptiTrack (CSV of Motive): a rigid body with quaternions; times in seconds.

    Args:
        path: the file.
        name: which object: of BOP its ``obj_id``, of OptiTrack its rigid body; the first one by default.
        frame_us: time from one image to the next (µs), for BOP.
        T_cam_world: where the camera is, for poses in a world frame.

    Raises:
        MissingFileError: if there is no such file.
        PoseError: if it is none of these, something is missing, or the poses make no sense.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"trajectory file '{path}' does not exist.")
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    try:
        if text.lstrip().startswith("{"):
            read = _read_bop(text, name, frame_us)
        elif text.startswith("Format Version"):
            read = _read_optitrack(text, name)
        elif "," in next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), ""):
            read = _read_csv(text)
        else:
            return _in_camera(read_tum(path), T_cam_world)
    except PoseError as error:
        raise PoseError(f"'{path}': {error}") from error
    return _in_camera(read, T_cam_world)


def _in_camera(trajectory: Trajectory, T_cam_world: Tensor | None) -> Trajectory:
    return trajectory if T_cam_world is None else Trajectory(trajectory.t_us, T_cam_world.to(torch.float64) @ trajectory.T_cam_obj)


def _trajectory(t_us: list[int], positions: list[list[float]], quaternions: list[list[float]]) -> Trajectory:
    T = torch.eye(4, dtype=torch.float64).repeat(len(t_us), 1, 1)
    xyzw = torch.tensor(quaternions, dtype=torch.float64).reshape(-1, 4)
    norms = xyzw.norm(dim=-1)
    if bool(((norms - 1).abs() > 0.01).any()):
        raise PoseError(f"a quaternion has norm {float(norms[(norms - 1).abs().argmax()]):.4g}, expected 1. Check the order of the columns.")
    T[:, :3, :3] = rotation_from_quaternion(xyzw)
    T[:, :3, 3] = torch.tensor(positions, dtype=torch.float64).reshape(-1, 3)
    return Trajectory(torch.tensor(t_us, dtype=torch.int64), T)


def _read_csv(text: str) -> Trajectory:
    rows = [row for row in csv.reader(text.splitlines()) if "".join(row).strip()]
    names = [_OTHER_NAMES.get(word.strip().lower().lstrip("# "), word.strip().lower().lstrip("# ")) for word in rows[0]]
    time = next((word for word in ("t_us", "time_us", "t", "time", "timestamp") if word in names), None)
    missing = [word for word in (*_POSITION, *_QUATERNION) if word not in names]
    if time is None or missing:
        raise PoseError(f"the first line must name t or t_us, tx, ty, tz, qx, qy, qz and qw; it names {', '.join(names)}.")
    t_us, positions, quaternions = [], [], []
    for number, row in enumerate(rows[1:], start=2):
        try:
            values = dict(zip(names, row, strict=True))
            t_us.append(int(values[time]) if time.endswith("_us") else parse_seconds(values[time]))
            positions.append([float(values[word]) for word in _POSITION])
            quaternions.append([float(values[word]) for word in _QUATERNION])
        except ValueError as error:
            raise PoseError(f"line {number} cannot be read: {error}.") from error
    return _trajectory(t_us, positions, quaternions)


def _read_bop(text: str, name: str | None, frame_us: int | None) -> Trajectory:
    if frame_us is None:
        raise PoseError("BOP numbers its images and does not say their times. Give frame_us, the time from one to the next (µs).")
    try:
        scene: dict[str, list[dict[str, Any]]] = json.loads(text)
        wanted = name if name is not None else str(next(iter(sorted(scene.items(), key=lambda item: int(item[0]))))[1][0]["obj_id"])
        found = [(int(image), entry) for image, entries in scene.items() for entry in entries if str(entry["obj_id"]) == wanted]
        found.sort(key=lambda item: item[0])
        T = np.tile(np.eye(4), (len(found), 1, 1))
        for pose, (_, entry) in zip(T, found, strict=True):
            pose[:3, :3] = np.reshape(entry["cam_R_m2c"], (3, 3))
            pose[:3, 3] = 1e-3 * np.asarray(entry["cam_t_m2c"], np.float64)
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, StopIteration) as error:
        raise PoseError(f"this is not the scene_gt.json of BOP ({type(error).__name__}: {error}).") from error
    return Trajectory(torch.tensor([image * frame_us for image, _ in found], dtype=torch.int64), torch.from_numpy(T))


def _read_optitrack(text: str, name: str | None) -> Trajectory:
    rows = list(csv.reader(text.splitlines()))
    header = dict(zip(rows[0][0::2], rows[0][1::2], strict=False))
    start = next((index for index, row in enumerate(rows) if row[:1] == ["Frame"]), None)
    if start is None or start < 4:
        raise PoseError("the export of Motive has no line 'Frame, Time (Seconds), …'. Export it as CSV with its header.")
    if header.get("Rotation Type", "Quaternion") != "Quaternion":
        raise PoseError(f"rotations are of type {header['Rotation Type']}. Export them as Quaternion.")
    columns = _body_columns(rows[:start], rows[start], name)
    unit = header.get("Length Units", "Meters").lower()
    if unit not in _METRES:
        raise PoseError(f"the unit '{unit}' is not known; known are {', '.join(_METRES)}.")
    t_us, positions, quaternions = [], [], []
    for row in rows[start + 1 :]:
        words = [row[column] if column < len(row) else "" for column in columns]
        # A body that the cameras lost has no numbers.
        if len(row) > 1 and all(words):
            try:
                t_us.append(parse_seconds(row[1]))
                quaternions.append([float(word) for word in words[:4]])
                positions.append([_METRES[unit] * float(word) for word in words[4:]])
            except ValueError as error:
                raise PoseError(f"frame {row[0]} cannot be read: {error}.") from error
    return _trajectory(t_us, positions, quaternions)


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
    chosen = bodies[0] if name is None else name
    columns = [
        next((c for c in range(width) if types[c] == "Rigid Body" and names[c] == chosen and kinds[c] == kind and axes[c] == axis), None)
        for kind, of_kind in (("Rotation", "XYZW"), ("Position", "XYZ"))
        for axis in of_kind
    ]
    found = [column for column in columns if column is not None]
    if len(found) != len(columns):
        raise PoseError(f"there is no rigid body '{chosen}' with rotation and position. Those there are: {', '.join(bodies)}.")
    return found
