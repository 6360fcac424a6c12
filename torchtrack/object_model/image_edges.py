"""Edges of an image to a fraction of a pixel: Canny, then the peak of the gradient along its direction."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

# Canny takes 16-bit gradients; the steepest step there can be (4 in log luminance, blurred) stays far below the limit.
_GRADIENT_SCALE = 8000
# Variance (px²) that the pixels' own size and the difference of two neighbours add to the blur.
_SAMPLING_VARIANCE = 1 / 12 + 1 / 3
# Canny's lower threshold: an edge is followed down to this share of the contrast it must have somewhere.
_HYSTERESIS = 0.5


@dataclass(frozen=True)
class ImageEdges:
    """``pixels [n, 2]`` (u, v; integers are pixel centres) on edges, and the unit ``gradients [n, 2]`` towards the brighter side."""

    pixels: np.ndarray
    gradients: np.ndarray


def image_edges(image: np.ndarray, blur_px: float, contrast: float) -> ImageEdges:
    """Edges of ``image [h, w]`` whose step is at least ``contrast``, in raster order; about one point per pixel of length."""
    blurred = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE)
    gx, gy = (cv2.Sobel(blurred, cv2.CV_32F, *order, ksize=3, scale=1 / 8, borderType=cv2.BORDER_REPLICATE) for order in ((1, 0), (0, 1)))
    # A blurred step of height h has a peak gradient of h / (σ √2π).
    high = contrast / np.sqrt(2 * np.pi * (blur_px**2 + _SAMPLING_VARIANCE))
    canny = cv2.Canny(_to_int16(gx), _to_int16(gy), _HYSTERESIS * high * _GRADIENT_SCALE, high * _GRADIENT_SCALE, L2gradient=True)
    v, u = np.nonzero(canny)
    gradients = np.stack([gx[v, u], gy[v, u]], 1).astype(np.float64)
    magnitude = np.linalg.norm(gradients, axis=1)
    gradients /= magnitude[:, None]
    pixels = np.stack([u, v], 1).astype(np.float64)
    return ImageEdges(pixels + _peak_offset(np.hypot(gx, gy), pixels, gradients)[:, None] * gradients, gradients)


def _to_int16(gradient: np.ndarray) -> np.ndarray:
    return np.round(gradient * _GRADIENT_SCALE).astype(np.int16)


def _peak_offset(magnitude: np.ndarray, pixels: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance (px) along ``directions`` to the peak of the gradient.

    The gradient of a blurred step is a Gaussian, so the parabola through the logarithm of three samples is exact.
    """
    before, at, after = (
        np.log(map_coordinates(magnitude, (pixels + step * directions).T[::-1], order=3, mode="nearest").clip(min=1e-6)) for step in (-1, 0, 1)
    )
    curvature = before - 2 * at + after
    peaked = curvature < -1e-6
    return np.where(peaked, 0.5 * (before - after) / np.where(peaked, curvature, 1), 0).clip(-1, 1)
