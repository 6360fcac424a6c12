"""Where the corners of a surface are, row by row: kornia's guided filter and Harris response, as in ``tracking/frontend/filters.py``.

Both take sums of neighbours, which kornia computes as convolutions with one channel: slow on a CPU. Here they are sums of rows, then of
places along them.
"""

from math import exp

import numpy as np

from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.tracking.frontend.filters import FILTER_EPS, FILTER_SIZE_PX, HARRIS_K

# Reach of the guided filter's boxes of 5 px.
_REACH_PX = FILTER_SIZE_PX // 2
# Weights of kornia's Gaussian window of 7 px along one axis, in the middle and on either side of it.
_WINDOW_REACH_PX, _SIGMA_PX = 3, 1.0
_UNNORMALISED = tuple(exp(-0.5 * (step / _SIGMA_PX) ** 2) for step in range(_WINDOW_REACH_PX + 1))
_WINDOW = tuple(weight / (2 * sum(_UNNORMALISED) - _UNNORMALISED[0]) for weight in _UNNORMALISED)
# Our sums of the Sobel operator are this many times the gradient.
_SOBEL_SCALE = 8.0


@kernel()
def _mirrored(place: int, length: int) -> int:
    """A place along an axis; beyond its ends, the image goes on mirrored."""
    return -place if place < 0 else (place if place < length else 2 * (length - 1) - place)


@kernel()
def _mirror(values: Array, reach: int) -> None:
    """Fill so many places at either end of a row with its mirrored continuation."""
    last = len(values) - 1
    for k in range(reach):
        values[k], values[last - k] = values[2 * reach - k], values[last - 2 * reach + k]


@kernel(fastmath=FAST)
def _sum_of_rows(image: Array, row: int, sums: Array) -> None:
    """Sums of the rows that a box around one row covers; ``sums`` is longer than a row by the box's reach at either end."""
    height, width = image.shape
    a, b, c = image[_mirrored(row - 2, height)], image[_mirrored(row - 1, height)], image[row]
    d, e = image[_mirrored(row + 1, height)], image[_mirrored(row + 2, height)]
    for u in range(width):
        sums[u + 2] = a[u] + b[u] + c[u] + d[u] + e[u]
    _mirror(sums, 2)


@kernel(fastmath=FAST)
def _sums_along(sums: Array, means: Array) -> None:
    """Means over boxes, from sums over their columns."""
    share = means.dtype.type(1.0 / FILTER_SIZE_PX**2)
    for u in range(len(means)):
        means[u] = (sums[u] + sums[u + 1] + sums[u + 2] + sums[u + 3] + sums[u + 4]) * share


@kernel(fastmath=FAST)
def guided_filter(image: Array, filtered: Array) -> None:
    """The guided filter of He et al. (2013) with the image as its own guide: smooths, and keeps edges. Fills ``filtered [h, w]``."""
    height, width = image.shape
    eps, squares = image.dtype.type(FILTER_EPS), image * image
    slopes, offsets = np.empty_like(image), np.empty_like(image)
    sums, means, mean_squares = np.empty(width + 2 * _REACH_PX, image.dtype), np.empty(width, image.dtype), np.empty(width, image.dtype)
    for v in range(height):
        _sum_of_rows(image, v, sums)
        _sums_along(sums, means)
        _sum_of_rows(squares, v, sums)
        _sums_along(sums, mean_squares)
        for u in range(width):
            variance = mean_squares[u] - means[u] * means[u]
            slope = variance / (variance + eps)
            slopes[v, u], offsets[v, u] = slope, means[u] - slope * means[u]
    for v in range(height):
        _sum_of_rows(slopes, v, sums)
        _sums_along(sums, means)
        _sum_of_rows(offsets, v, sums)
        _sums_along(sums, mean_squares)
        for u in range(width):
            filtered[v, u] = mean_squares[u] + means[u] * image[v, u]


@kernel(fastmath=FAST)
def harris(image: Array, response: Array) -> None:
    """Harris response ``det M - k tr² M`` with Sobel gradients and a Gaussian window; fills ``response [h, w]``."""
    height, width = image.shape
    products = np.empty((3, height, width), image.dtype)
    _gradient_products(image, products)
    k = image.dtype.type(HARRIS_K)
    sums, rows = np.empty(width + 2 * _WINDOW_REACH_PX, image.dtype), np.empty((3, width), image.dtype)
    for v in range(height):
        for number in range(3):
            _windowed(products[number], v, sums, rows[number])
        for u in range(width):
            uu, vv, uv = rows[0, u], rows[1, u], rows[2, u]
            trace = uu + vv
            response[v, u] = uu * vv - uv * uv - k * trace * trace


@kernel(fastmath=FAST)
def _gradient_products(image: Array, products: Array) -> None:
    """Products of the gradient's parts, ``du²``, ``dv²`` and ``du dv``; beyond its border an image goes on with its outermost pixels."""
    height, width = image.shape
    scale, two = image.dtype.type(1.0 / _SOBEL_SCALE), image.dtype.type(2.0)
    smooth, step = np.empty(width + 2, image.dtype), np.empty(width + 2, image.dtype)
    for v in range(height):
        above, own, below = image[max(v - 1, 0)], image[v], image[min(v + 1, height - 1)]
        for u in range(width):
            smooth[u + 1] = (above[u] + two * own[u] + below[u]) * scale
            step[u + 1] = (below[u] - above[u]) * scale
        smooth[0], smooth[-1], step[0], step[-1] = smooth[1], smooth[-2], step[1], step[-2]
        uu, vv, uv = products[0, v], products[1, v], products[2, v]
        for u in range(width):
            du, dv = smooth[u + 2] - smooth[u], step[u] + two * step[u + 1] + step[u + 2]
            uu[u], vv[u], uv[u] = du * du, dv * dv, du * dv


@kernel(fastmath=FAST)
def _windowed(image: Array, row: int, sums: Array, means: Array) -> None:
    """Means of one row by the Gaussian window; ``sums`` is longer than a row by the window's reach at either end."""
    height, width = image.shape
    w0, w1, w2, w3 = (image.dtype.type(_WINDOW[0]), image.dtype.type(_WINDOW[1]), image.dtype.type(_WINDOW[2]), image.dtype.type(_WINDOW[3]))
    a, b, c, d = image[_mirrored(row - 3, height)], image[_mirrored(row - 2, height)], image[_mirrored(row - 1, height)], image[row]
    e, f, g = image[_mirrored(row + 1, height)], image[_mirrored(row + 2, height)], image[_mirrored(row + 3, height)]
    for u in range(width):
        sums[u + 3] = w0 * d[u] + w1 * (c[u] + e[u]) + w2 * (b[u] + f[u]) + w3 * (a[u] + g[u])
    _mirror(sums, 3)
    for u in range(width):
        means[u] = w0 * sums[u + 3] + w1 * (sums[u + 2] + sums[u + 4]) + w2 * (sums[u + 1] + sums[u + 5]) + w3 * (sums[u] + sums[u + 6])


@kernel()
def corner_responses(surfaces: Array, responses: Array) -> None:
    """Fill ``responses [b, h, w]``: Harris of what the guided filter leaves of each surface."""
    filtered = np.empty(surfaces.shape[1:], surfaces.dtype)
    for b in range(len(surfaces)):
        guided_filter(surfaces[b], filtered)
        harris(filtered, responses[b])
