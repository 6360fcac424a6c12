"""A pose from points that somebody picked: pixels, and the points of the model that are seen there.

A file of picks has the header ``u,v,x,y,z``: sensor pixels, and the numbers that the model's file has.
"""

import csv
import warnings
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from torchtrack.core.camera import Camera, project, undistort
from torchtrack.errors import PoseError, TorchtrackWarning
from torchtrack.io.whole_text import read_text_file

COLUMNS = ("u", "v", "x", "y", "z")
FEWEST_PICKS = 4
# Points that lie so near to a line, of their extent along it, leave the rotation about it open.
_ON_A_LINE = 0.02
# Picks that are farther off than this from the pose that fits them best (px) are doubtful.
_DOUBTFUL_PX = 10.0
_LOOK = "Look whether each line has the point of its pixel."


@dataclass(frozen=True)
class Picks:
    """Pixels of a sensor and the points that are seen there.

    Args:
        pixels: of the sensor, distorted as the lens does it.
        points: in the numbers of the model's file; from :meth:`scaled` on, in metres in the object's frame.
        name: where they are from, for messages.
    """

    pixels: Float[ndarray, "n 2"]
    points: Float[ndarray, "n 3"]
    name: str

    def scaled(self, metres: float, origin_m: Float[ndarray, "3"]) -> "Picks":
        """With their points in metres in the object's frame, whose origin is at a point (m) of the file's."""
        return Picks(self.pixels, self.points * metres - origin_m, self.name)


def read_picks(path: Path) -> Picks:
    """The picks in a file.

    Raises:
        MissingFileError, LimitError: if it is not there, or too large.
        PoseError: if its header or a line is not as it should be.
    """
    lines = read_text_file(path, "file of picks", "text_bytes", PoseError).splitlines()
    rows = [row for row in csv.reader(lines) if row and not row[0].lstrip().startswith("#")]
    header = tuple(word.strip().lower() for word in rows[0]) if rows else ()
    if header != COLUMNS:
        got = ",".join(header)
        raise PoseError(f"'{path}': expected the first line '{','.join(COLUMNS)}', got '{got}'. Pixels come first, then the model's x, y, z.")
    values = np.array([_numbers(row, path) for row in rows[1:]]).reshape(-1, len(COLUMNS))
    # OpenCV takes no views of arrays.
    return Picks(values[:, :2].copy(), values[:, 2:].copy(), f"'{path}'")


def _numbers(row: list[str], path: Path) -> list[float]:
    try:
        values = [float(word) for word in row]
    except ValueError:
        values = []
    if len(values) != len(COLUMNS) or not np.isfinite(values).all():
        raise PoseError(f"'{path}': the line '{','.join(row)}' is not five numbers {','.join(COLUMNS)}.")
    return values


def pose_of_picks(picks: Picks, camera: Camera) -> Float[Tensor, "4 4"]:
    """The pose ``T_cam_obj`` (float64) that puts the points on their pixels.

    SQPNP (Terzakis and Lourakis, "A consistently fast and globally optimal solution to the perspective-n-point problem", 2020), as OpenCV has it.
    Warns (:class:`TorchtrackWarning`) of picks that do not fit.

    Args:
        picks: with points in metres in the object's frame.
        camera: that sees them.

    Raises:
        PoseError: if there are too few, they lie on a line or outside the image, or no pose fits them.
    """
    _check(picks, camera)
    ideal = undistort(picks.pixels, camera)
    solved, turn, translation = cv2.solvePnP(picks.points, ideal, camera.matrix, None, flags=cv2.SOLVEPNP_SQPNP)
    if not solved or not np.isfinite(turn).all():
        raise PoseError(f"{picks.name}: no pose puts these points on their pixels. {_LOOK}")
    turn, translation = cv2.solvePnPRefineLM(picks.points, ideal, camera.matrix, None, turn, translation)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], translation[:, 0]
    points_cam = picks.points @ T[:3, :3].T + T[:3, 3]
    if (points_cam[:, 2] <= 0).any():
        raise PoseError(f"{picks.name}: the pose that fits these points best has some behind the camera. {_LOOK}")
    off_px = np.linalg.norm(project(torch.from_numpy(points_cam), camera.intrinsics(torch.float64)).numpy() - ideal, axis=1)
    if off_px.max() > _DOUBTFUL_PX:
        worst = int(off_px.argmax())
        message = f"{picks.name}: pick {worst + 1} is {off_px[worst]:.0f} px off the pose that fits all best. Look whether it is the right point."
        warnings.warn(message, TorchtrackWarning, stacklevel=2)
    return torch.from_numpy(T)


def _check(picks: Picks, camera: Camera) -> None:
    count = len(picks.pixels)
    if count < FEWEST_PICKS:
        raise PoseError(f"{picks.name}: {count} picks are too few; at least {FEWEST_PICKS} are needed, and six are better.")
    outside = (picks.pixels < -0.5).any(1) | (picks.pixels > np.array([camera.width, camera.height]) - 0.5).any(1)
    if outside.any():
        u, v = picks.pixels[int(outside.argmax())]
        raise PoseError(f"{picks.name}: pixel ({u:g}, {v:g}) is outside the image of {camera.width}x{camera.height}. Is it of another camera?")
    extent = np.linalg.svd(picks.points - picks.points.mean(0), compute_uv=False)
    if extent[1] <= _ON_A_LINE * extent[0]:
        raise PoseError(f"{picks.name}: all points lie on a line, about which the object may turn. Pick some beside it.")
