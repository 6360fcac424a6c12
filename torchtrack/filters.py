"""Guided filter and Harris response: kornia's, and the same sums taken by shifted slices.

kornia's run as convolutions with one channel, which a CPU does slowly. The ``sliced`` variants add shifted slices
instead; they are the same to 1e-5 (a test holds them to it) and several times faster on the CPU.
"""

from functools import cache

import torch
from jaxtyping import Float
from kornia.feature import harris_response
from kornia.filters import get_gaussian_kernel1d, guided_blur
from torch import Tensor
from torch.nn.functional import pad

from torchtrack.config.tracker import SurfaceConfig

_HARRIS_K = 0.04
_HARRIS_WINDOW_PX, _HARRIS_SIGMA_PX = 7, 1.0
# Weights of the Sobel operator, normalised to the gradient's scale.
_SOBEL_SMOOTH, _SOBEL_DIFFERENCE = (0.25, 0.5, 0.25), (-0.5, 0.0, 0.5)


def corner_response(surface: Float[Tensor, "b h w"], config: SurfaceConfig) -> Float[Tensor, "b h w"]:
    """Harris response of the surface after the guided filter, with the surface as its own guide.

    Args:
        config: ``filters`` picks kornia's implementation or the sliced one; they agree.
    """
    if config.filters == "kornia":
        image = surface[:, None]
        filtered = guided_blur(image, image, config.filter_size_px, config.filter_eps, subsample=config.filter_subsample)
        return harris_response(filtered, _HARRIS_K)[:, 0]
    return sliced_harris(sliced_guided_filter(surface, config.filter_size_px, config.filter_eps))


def _weighted_shifts(image: Tensor, weights: tuple[float, ...], axis: int) -> Tensor:
    """Correlation along one axis of an image that is already padded."""
    length = image.shape[axis] - len(weights) + 1
    total = image.narrow(axis, 0, length) * weights[0]
    for shift, weight in enumerate(weights[1:], 1):
        if weight:
            total.add_(image.narrow(axis, shift, length), alpha=weight)
    return total


def separable_filter(
    image: Float[Tensor, "b h w"], vertical: tuple[float, ...], horizontal: tuple[float, ...], border: str
) -> Float[Tensor, "b h w"]:
    """Correlation with the outer product of two odd kernels; ``border`` as in ``torch.nn.functional.pad``."""
    rows, columns = len(vertical) // 2, len(horizontal) // 2
    padded = pad(image[:, None], (columns, columns, rows, rows), border)[:, 0]
    return _weighted_shifts(_weighted_shifts(padded, vertical, -2), horizontal, -1)


def sliced_guided_filter(surface: Float[Tensor, "b h w"], size_px: int, eps: float) -> Float[Tensor, "b h w"]:
    """The guided filter of He et al. (2013) with the image as its own guide: smooths, and keeps edges."""
    box = (1.0 / size_px,) * size_px

    def mean(*images: Tensor) -> tuple[Tensor, ...]:
        return separable_filter(torch.cat(images), box, box, "reflect").chunk(len(images))

    average, square = mean(surface, surface.square())
    variance = square - average.square()
    slope = variance / (variance + eps)
    mean_slope, mean_offset = mean(slope, average - slope * average)
    return mean_slope * surface + mean_offset


@cache
def _harris_window() -> tuple[float, ...]:
    """Weights of the Gaussian window along one axis; they never change."""
    return tuple(get_gaussian_kernel1d(_HARRIS_WINDOW_PX, _HARRIS_SIGMA_PX, dtype=torch.float64)[0].tolist())


def sliced_harris(image: Float[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
    """Harris response ``det M - k tr² M`` with Sobel gradients and a 7x7 Gaussian window."""
    du = separable_filter(image, _SOBEL_SMOOTH, _SOBEL_DIFFERENCE, "replicate")
    dv = separable_filter(image, _SOBEL_DIFFERENCE, _SOBEL_SMOOTH, "replicate")
    window = _harris_window()
    uu, vv, uv = separable_filter(torch.cat([du * du, dv * dv, du * dv]), window, window, "reflect").chunk(3)
    return uu * vv - uv.square() - _HARRIS_K * (uu + vv).square()
