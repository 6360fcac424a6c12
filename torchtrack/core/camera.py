"""The camera: pinhole projection, plumb-bob and fisheye distortion, and the undistortion table.

Conventions, stated once: OpenCV frame (x right, y down, z forward); integer pixel (u, v) is the CENTRE of that pixel,
so an event (x, y) is at u = x, v = y; image tensors are ``[..., H, W]``.

Geometry is done in *ideal* pixels: those that the same camera without distortion would have. Events are taken there by
a lookup table, once; only what must be found on the sensor (a region of interest) is distorted.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.camera_check import as_coefficients, check_lens, check_tangential, checked_matrix
from torchtrack.core.limits import check_limit
from torchtrack.errors import CalibrationError

DistortionModel = Literal["none", "plumb_bob", "fisheye"]

_COEFFICIENTS = {"none": (0,), "plumb_bob": (4, 5, 8), "fisheye": (4,)}

# Points nearer than this to the camera plane have no useful projection; callers mask them.
MIN_DEPTH_M = 1e-3

# OpenCV's own stopping rule leaves 0.1 px at the corners of a wide lens.
_UNTIL_EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
_LARGEST_MISMATCH_PX = 0.01


@dataclass(frozen=True)
class Camera:
    """Intrinsics and distortion of one camera.

    Args:
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        width, height: sensor size in pixels.
        distortion_model: ``"plumb_bob"`` (k1 k2 p1 p2 [k3 [k4 k5 k6]]) or ``"fisheye"`` (k1 k2 k3 k4), as in OpenCV.
        distortion: the coefficients: a list, array or tensor of shape ``[n]``, ``[1, n]`` or ``[n, 1]``; kept as a tuple of floats.
        derived: made from another camera that was checked: a region of its image, or its image without distortion. The size says
            nothing then about what focal lengths and principal point can be.

    Warns (:class:`~torchtrack.errors.TorchtrackWarning`) of numbers that few cameras have.

    Raises:
        CalibrationError: if a number makes no sense, or no camera has it.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    # Any text, because it may come from a file: an unknown one is reported as every other mistake is.
    distortion_model: str = "none"
    distortion: Any = ()
    derived: bool = field(default=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", as_coefficients(self.distortion))
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy, *self.distortion]).all():
            raise CalibrationError(f"camera intrinsics must be finite, got {self}.")
        if self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(f"focal lengths must be positive and in pixels, got fx={self.fx}, fy={self.fy}.")
        if int(self.width) != self.width or int(self.height) != self.height:
            raise CalibrationError(f"width and height must be whole numbers of pixels, got {self.width} and {self.height}.")
        if self.width < 1 or self.height < 1:
            raise CalibrationError(f"the sensor size must be positive, got {self.width}x{self.height}.")
        if self.distortion_model not in _COEFFICIENTS:
            raise CalibrationError(f"unknown distortion model '{self.distortion_model}': use one of {', '.join(_COEFFICIENTS)}.")
        if len(self.distortion) not in _COEFFICIENTS[self.distortion_model]:
            raise CalibrationError(
                f"the distortion model '{self.distortion_model}' takes {' or '.join(map(str, _COEFFICIENTS[self.distortion_model]))} "
                f"coefficients, got {len(self.distortion)}."
            )
        if not self.derived:
            check_lens((self.fx, self.fy), (self.cx, self.cy), (self.width, self.height))
            if self.distortion_model == "plumb_bob":
                check_tangential(self.distortion)

    @classmethod
    def from_matrix(cls, K: Any, width: int, height: int, distortion_model: str = "none", distortion: Any = ()) -> "Camera":
        """A camera from its 3x3 matrix ``K``; a skew of less than half a pixel is left out, and told.

        Raises:
            CalibrationError: if ``K`` is no camera matrix, or as :class:`Camera`.
        """
        K = checked_matrix(K, height)
        return cls(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height, distortion_model, distortion)

    @property
    def matrix(self) -> np.ndarray:
        """The 3x3 camera matrix (float64)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def intrinsics(self, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None) -> Float[Tensor, "4"]:
        """``[fx, fy, cx, cy]`` as a tensor."""
        return torch.tensor([self.fx, self.fy, self.cx, self.cy], dtype=dtype, device=device)


def project(points_cam: Float[Tensor, "*b n 3"], intrinsics: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b n 2"]:
    """Ideal pixels of points in the camera frame (the paper's Eq. 3).

    Depths are clamped to :data:`MIN_DEPTH_M`: points at or behind the camera give finite pixels that mean nothing, so
    mask them by their depth.
    """
    inverse_depth = points_cam[..., 2:].clamp(min=MIN_DEPTH_M).reciprocal()
    return points_cam[..., :2] * inverse_depth * intrinsics[..., None, :2] + intrinsics[..., None, 2:]


def distort(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Sensor pixels of ideal pixels ``[n, 2]``."""
    pixels = np.asarray(pixels, dtype=np.float64)
    if camera.distortion_model == "none" or len(pixels) == 0:
        return pixels
    rays = np.concatenate([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones((len(pixels), 1))], 1)
    coefficients, zero = np.array(camera.distortion), np.zeros(3)
    module = cv2.fisheye if camera.distortion_model == "fisheye" else cv2
    distorted, _ = module.projectPoints(rays[:, None], zero, zero, camera.matrix, coefficients)
    return distorted[:, 0]


def undistort(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Ideal pixels of sensor pixels ``[n, 2]``."""
    pixels = np.asarray(pixels, dtype=np.float64)
    if camera.distortion_model == "none" or len(pixels) == 0:
        return pixels
    coefficients, matrix = np.array(camera.distortion), camera.matrix
    if camera.distortion_model == "fisheye":
        return cv2.fisheye.undistortPoints(pixels[:, None], matrix, coefficients, R=np.eye(3), P=matrix)[:, 0]
    return cv2.undistortImagePoints(pixels[:, None], matrix, coefficients, None, _UNTIL_EXACT)[:, 0]


# Tables are made in bands of so many pixels: what making them takes does not grow with the sensor.
_BAND_PIXELS = 1 << 20


def undistortion_table(camera: Camera) -> Float[Tensor, "h w 2"]:
    """Ideal pixel (u, v) of the centre of every sensor pixel, float32.

    Raises:
        CalibrationError: if some pixel has no ideal pixel of its own: the coefficients are wrong, or the lens sees 180° or more.
        LimitError: if the sensor is larger than ``limits.sensor_pixels``.
    """
    table, failed, first = _empty_table(camera, 0), 0, (0, 0)
    for rows, sensor in _bands(range(camera.height), range(camera.width)):
        ideal = undistort(sensor, camera)
        # Written so that NaN fails too.
        wrong = ~(np.abs(distort(ideal, camera) - sensor).max(1) < _LARGEST_MISMATCH_PX)
        if wrong.any() and not failed:
            first = tuple(sensor[wrong][0].tolist())
        failed += int(wrong.sum())
        table[rows] = ideal.reshape(-1, camera.width, 2)
    if failed:
        raise CalibrationError(
            f"the {camera.distortion_model} distortion {camera.distortion} cannot be undone at {failed} of {camera.width * camera.height} pixels, "
            f"first at {first}. Check the order and number of its coefficients, or use another distortion model."
        )
    _check_unfolded(table, camera)
    return torch.from_numpy(table)


def _check_unfolded(table: np.ndarray, camera: Camera) -> None:
    """Raise ``CalibrationError`` where neighbours on the sensor have changed sides: the coefficients fold the image."""
    if camera.distortion_model == "none":
        return
    right, down = np.diff(table[:-1], axis=1), np.diff(table[:, :-1], axis=0)
    folded = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0] <= 0
    if folded.any():
        v, u = np.argwhere(folded)[0].tolist()
        raise CalibrationError(
            f"the {camera.distortion_model} distortion {camera.distortion} folds the image at {folded.sum()} pixels, first at {(u, v)}: two "
            "directions fall on one pixel. Check the order and number of its coefficients, or use another distortion model."
        )


def distortion_table(camera: Camera, border_px: int) -> Float[Tensor, "h w 2"]:
    """Sensor pixel (u, v) of every ideal pixel, float32, for the image and a border of ``border_px`` around it.

    Raises:
        LimitError: if the sensor is larger than ``limits.sensor_pixels``.
    """
    across, along = range(-border_px, camera.width + border_px), range(-border_px, camera.height + border_px)
    table = _empty_table(camera, border_px)
    for rows, pixels in _bands(along, across):
        table[rows] = distort(pixels, camera).reshape(-1, len(across), 2)
    return torch.from_numpy(table)


def _empty_table(camera: Camera, border_px: int) -> Float[np.ndarray, "h w 2"]:
    check_limit("sensor_pixels", camera.width * camera.height, f"the camera of {camera.width}x{camera.height} pixels")
    return np.empty((camera.height + 2 * border_px, camera.width + 2 * border_px, 2), np.float32)


def _bands(along: range, across: range) -> Iterator[tuple[slice, np.ndarray]]:
    """Rows of an image in bands: where they are, and the pixels (u, v) of all of them."""
    rows = max(1, _BAND_PIXELS // len(across))
    for start in range(0, len(along), rows):
        part = along[start : start + rows]
        v, u = np.mgrid[part.start : part.stop, across.start : across.stop]
        yield slice(start, start + len(part)), np.stack([u.ravel(), v.ravel()], 1)


def stack_tables(tables: list[Float[Tensor, "_ _ 2"]], beyond_px: int = 0) -> Float[Tensor, "s h w 2"]:
    """Tables of cameras of different sizes as one tensor, with ``beyond_px`` wherever a smaller one has no entry."""
    height, width = max(t.shape[0] for t in tables), max(t.shape[1] for t in tables)
    return torch.stack([torch.nn.functional.pad(t, (0, 0, 0, width - t.shape[1], 0, height - t.shape[0]), value=beyond_px) for t in tables])
