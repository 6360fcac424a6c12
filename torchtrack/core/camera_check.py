"""Numbers that a camera can have: what no camera has is refused, what few have is told.

Bounds are wide: a lens of 250° has a focal length of 0.23 image sizes, one of 1° has 57.
"""

import warnings
from typing import Any

import numpy as np

from torchtrack.errors import CalibrationError, TorchtrackWarning

_FOCAL_SIZES = (0.1, 50.0)
# Lenses put the principal point within a few hundredths of the middle; a calibration of another resolution puts it at a quarter.
_OFF_CENTRE = 0.2
_FAR_OUTSIDE = 1.0
# As near as this to the middle of an image whose width and height are exchanged.
_TURNED = 0.05
_USUAL_ASPECT, _LARGEST_ASPECT = 1.2, 3.0
_LARGEST_SKEW_PX = 0.5
# Plumb-bob lenses are decentred by thousandths.
_USUAL_TANGENTIAL = 0.05


def check_lens(focal_px: tuple[float, float], principal_px: tuple[float, float], size_px: tuple[int, int]) -> None:
    """Refuse focal lengths and a principal point that no camera of this size has, and warn of those that few have.

    Args:
        focal_px: fx and fy.
        principal_px: cx and cy.
        size_px: width and height.

    Raises:
        CalibrationError: with what the numbers may be instead.
    """
    _check_focal(focal_px, size_px)
    for name, at, length in zip(("cx", "cy"), principal_px, size_px, strict=True):
        if not -_FAR_OUTSIDE * length <= at <= (1 + _FAR_OUTSIDE) * length:
            raise CalibrationError(
                f"the principal point is far outside the image: {name} is {at:g} for {length} pixels. It is in pixels from the top left; "
                "check the order fx, fy, cx, cy, and whether the calibration is of this camera."
            )
    doubts = list(_doubts(focal_px, principal_px, size_px))
    if doubts:
        warnings.warn(f"this calibration is unusual: {'; '.join(doubts)}. Poses are as right as it is.", TorchtrackWarning, stacklevel=5)


def _check_focal(focal_px: tuple[float, float], size_px: tuple[int, int]) -> None:
    (fx, fy), longest = focal_px, max(size_px)
    shown = f"fx={fx:g}, fy={fy:g} with {size_px[0]}x{size_px[1]} pixels"
    low, high = _FOCAL_SIZES
    if min(fx, fy) < low * longest:
        hint = "These look normalised: multiply fx and cx by the width, fy and cy by the height." if max(fx, fy) < 3 else "Are these in mm?"
        raise CalibrationError(f"no lens has focal lengths as short as {shown}; they are in pixels. {hint} Is the sensor size right?")
    if max(fx, fy) > high * longest:
        raise CalibrationError(f"no lens has focal lengths as long as {shown}. They are in pixels; is the sensor size right?")
    if max(fx, fy) > _LARGEST_ASPECT * min(fx, fy):
        raise CalibrationError(f"no camera has focal lengths as different as {shown}. Check the order fx, fy, cx, cy.")


def _doubts(focal_px: tuple[float, float], principal_px: tuple[float, float], size_px: tuple[int, int]) -> list[str]:
    (fx, fy), (width, height) = focal_px, size_px
    doubts = []
    if max(fx, fy) > _USUAL_ASPECT * min(fx, fy):
        doubts.append(f"fx={fx:g} and fy={fy:g} differ by more than {100 * (_USUAL_ASPECT - 1):.0f} %, as if pixels were not square")
    turned = [abs(2 * at + 1 - length) < _TURNED * length for at, length in zip(principal_px, (height, width), strict=True)]
    if all(turned) and abs(width - height) > 2 * _TURNED * max(width, height):
        doubts.append(
            f"the principal point ({principal_px[0]:g}, {principal_px[1]:g}) is the middle of {height} x {width}: width and height look exchanged"
        )
        return doubts
    off = [abs(at - (length - 1) / 2) / length for at, length in zip(principal_px, size_px, strict=True)]
    if max(off) > _OFF_CENTRE:
        middle = " x ".join(f"{max(2 * at + 1, 0):.0f}" for at in principal_px)
        doubts.append(
            f"the principal point ({principal_px[0]:g}, {principal_px[1]:g}) is far from the middle of {width} x {height} pixels, "
            f"and would be the middle of {middle}: is it for another resolution, or another part of the sensor?"
        )
    return doubts


def check_tangential(coefficients: tuple[float, ...]) -> None:
    """Warn of plumb-bob coefficients p1 and p2 that few lenses have."""
    if max(map(abs, coefficients[2:4])) > _USUAL_TANGENTIAL:
        warnings.warn(
            f"this calibration is unusual: the third and fourth plumb-bob coefficients are p1={coefficients[2]:g} and p2={coefficients[3]:g}, "
            "and thousandths in most lenses. Check their order (k1 k2 p1 p2 k3), and whether they are of a fisheye model (k1 k2 k3 k4).",
            TorchtrackWarning,
            stacklevel=5,
        )


def checked_matrix(K: Any, height: int) -> np.ndarray:
    """The 3x3 camera matrix ``K`` as float64, where it is one.

    Warns where a skew moves no pixel by more than half a pixel: it is left out.

    Raises:
        CalibrationError: if it is not, or has a skew that matters.
    """
    try:
        K = np.asarray(K, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"the camera matrix must hold numbers ({error}).") from error
    if K.shape != (3, 3):
        raise CalibrationError(f"the camera matrix must be 3x3, got shape {K.shape}.")
    if not np.isfinite(K).all():
        raise CalibrationError(f"the camera matrix must be finite, got {K.tolist()}.")
    rows = "[fx, 0, cx], [0, fy, cy], [0, 0, 1]"
    if K[1, 0] != 0 or not np.allclose(K[2], [0, 0, 1], rtol=0, atol=1e-6):
        hint = " It is transposed." if np.allclose(K[:2, 2], 0) and K[2, :2].any() else ""
        raise CalibrationError(f"the camera matrix must be {rows}, got {K.tolist()}.{hint}")
    # What leaving it out moves at the upper or lower border.
    moved_px = abs(K[0, 1] / K[1, 1]) * height / 2 if K[1, 1] else 0.0
    if moved_px > _LARGEST_SKEW_PX:
        raise CalibrationError(
            f"the camera matrix has a skew of {K[0, 1]:g}, which moves pixels by up to {moved_px:.1f}; the rows must be {rows}. "
            "Calibrate without skew (MATLAB: EstimateSkew false)."
        )
    if moved_px > 0:
        warnings.warn(f"the camera matrix has a skew of {K[0, 1]:g} (up to {moved_px:.2g} px), which is left out.", TorchtrackWarning, stacklevel=4)
    return K


def as_coefficients(distortion: object) -> tuple[float, ...]:
    """Distortion coefficients of any kind of list, array or tensor of shape ``[n]``, ``[1, n]`` or ``[n, 1]``, as floats.

    Raises:
        CalibrationError: if they are no numbers, or of another shape.
    """
    detached = distortion.detach().cpu() if hasattr(distortion, "detach") else distortion
    try:
        numbers = np.asarray(detached, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"the distortion must be a list of numbers, got {distortion!r}.") from error
    if numbers.ndim not in (1, 2) or (numbers.ndim == 2 and 1 not in numbers.shape and numbers.size):
        raise CalibrationError(f"the distortion must have shape [n], [1, n] or [n, 1], got {list(numbers.shape)}.")
    return tuple(numbers.ravel().tolist())
