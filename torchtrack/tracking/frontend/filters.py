"""From the time surface to where its corners are: kornia's guided filter and Harris response.

On a CPU, a kernel takes the place of all that looks for corners (``torchtrack/backends/numba/corners.py``): kornia's convolutions with one
channel are slow there.
"""

import torch
from jaxtyping import Float
from kornia.feature import harris_response
from kornia.filters import guided_blur
from torch import Tensor

# Side of the guided filter's window (px, odd), and its regularisation (squared intensity; a surface is from 0 to 1). Both were set with the
# first corners, and not measured alone.
FILTER_SIZE_PX, FILTER_EPS = 5, 0.01
HARRIS_K = 0.04
# Large temporaries page-fault on the CPU: surfaces are filtered this many at a time.
_CHUNK = 8


def corner_response(surface: Float[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
    """Harris response of the surface after the guided filter of He et al. (2013), with the surface as its own guide."""
    images = surface[:, None]
    parts = images.split(_CHUNK) if images.device.type == "cpu" else (images,)
    return torch.cat([harris_response(guided_blur(part, part, FILTER_SIZE_PX, FILTER_EPS), HARRIS_K) for part in parts])[:, 0]
