"""Guided filter and Harris response of a time surface: ours, kornia's and OpenCV's."""

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from kornia.feature import harris_response
from kornia.filters import guided_blur
from numpy import ndarray

from torchtrack.backends.numba.corner_response import guided_filter, harris
from torchtrack.bench.peers.comparison import Comparison, Work
from torchtrack.bench.surface import WINDOW_US, random_events
from torchtrack.config.tracker import SurfaceConfig
from torchtrack.tracking.frontend.filters import FILTER_EPS, FILTER_SIZE_PX, HARRIS_K
from torchtrack.tracking.frontend.time_surface import Regions, empty_last_event, time_surface, update_last_event

# Width and height: an object's region, and the whole sensor.
SIZES = ((208, 208), (640, 480))
_TAU_S = SurfaceConfig().tau_s
_HARRIS_WINDOW_PX = 7
# Borders are treated differently (px).
_BORDER_PX = 12


def compare(comparison: Comparison) -> None:
    """Measure all that are here."""
    for width, height in SIZES:
        image = surface_image(width, height).to(comparison.setup.device)
        plain, size = image[0].cpu().numpy(), f"{width}x{height}"
        smoothed = comparison.time(f"guided filter {size}: torchtrack", partial(_filtered, guided_filter, plain))
        response = comparison.time(f"Harris {size}: torchtrack", partial(_filtered, harris, plain))
        expected = _filtered(guided_filter, plain)
        works = (
            (smoothed, "kornia", "kornia", partial(_kornia_guided, image), expected),
            (smoothed, "OpenCV", "opencv-contrib-python-headless, in place of opencv-python-headless", partial(_opencv_guided, plain), expected),
            (response, "kornia", "kornia", partial(_kornia_harris, image), _filtered(harris, plain)),
            (response, "OpenCV", "opencv-python-headless", partial(_opencv_harris, plain), None),
        )
        for ours, name, package, make, result in works:
            full_name = ours.name.replace("torchtrack", name)
            work = comparison.prepare(full_name, package, make)
            if work is not None:
                comparison.ahead(comparison.time(full_name, work), ours)
                _compare_images(comparison, full_name, result, np.asarray(work()))


def surface_image(width: int, height: int) -> Float[torch.Tensor, "1 h w"]:
    """The time surface of random events, a quarter as many as there are pixels."""
    newest = update_last_event(empty_last_event(1, height, width), random_events(width, height, width * height // 4))
    zeros = torch.zeros(1, 2, dtype=torch.int64)
    regions = Regions(zeros, torch.tensor([[width, height]]), (height, width), zeros[:, 0])
    return time_surface(newest, torch.tensor([WINDOW_US]), regions, _TAU_S, torch.float32)


def _filtered(filtering: Callable[[ndarray, ndarray], None], image: ndarray) -> ndarray:
    """What a kernel makes of an image."""
    result = np.empty_like(image)
    filtering(image, result)
    return result


def _compare_images(comparison: Comparison, name: str, ours: ndarray | None, theirs: ndarray) -> None:
    """Note how far the results are apart."""
    if ours is None:
        comparison.notes.append(f"{name}: with a box in place of a Gaussian window, so its response is another one")
        return
    inside = (slice(_BORDER_PX, -_BORDER_PX),) * 2
    difference = float(np.abs(ours - theirs)[inside].max())
    comparison.notes.append(f"{name}: equal to ours to {difference:.1g}, of {float(np.abs(ours).max()):.2g}, beside the border")


def _kornia_guided(image: torch.Tensor) -> Work:
    return lambda: guided_blur(image[:, None], image[:, None], FILTER_SIZE_PX, FILTER_EPS)[0, 0].cpu()


def _kornia_harris(image: torch.Tensor) -> Work:
    return lambda: harris_response(image[:, None], HARRIS_K)[0, 0].cpu()


def _opencv_guided(image: ndarray) -> Work:
    # Only OpenCV's contributed modules have it, and its type stubs do not know.
    contributed: Any = cv2
    guided_filter = contributed.ximgproc.guidedFilter
    return lambda: guided_filter(image, image, FILTER_SIZE_PX // 2, FILTER_EPS)


def _opencv_harris(image: ndarray) -> Work:
    return lambda: cv2.cornerHarris(image, _HARRIS_WINDOW_PX, 3, HARRIS_K)
