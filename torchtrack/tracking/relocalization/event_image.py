"""The events of a window as an image with a border, in which poses are looked for."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from torchtrack.core.constants import constant

# Pixels around the image that events and contours may lie in.
BORDER_PX = 2


def event_density(pixels: Float[Tensor, "1 e 2"], mask: Bool[Tensor, "1 e"], image_size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """Events in the 3x3 pixels around every pixel of the image with its border."""
    height, width = (size + 2 * BORDER_PX for size in image_size)
    place = (pixels[0].round() + BORDER_PX).nan_to_num(-1)
    inside = mask[0] & (place >= 1).all(-1) & (place[:, 0] < width - 1) & (place[:, 1] < height - 1)
    u, v = torch.where(inside[:, None], place, 0).long().unbind(-1)
    image = torch.zeros(height * width, dtype=pixels.dtype, device=pixels.device)
    image = image.scatter_add(0, v * width + u, inside.to(pixels.dtype)).view(height, width)
    rows = image[:-2] + image[1:-1] + image[2:]
    return pad(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:], (1, 1, 1, 1))


def look_up(image: Float[Tensor, "h w"], pixels: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n"]:
    """What an image with its border has at some pixels; outside of it, what is at its rim."""
    limit = constant((image.shape[1] - 1, image.shape[0] - 1), image.dtype, image.device)
    # Clamped before the conversion: a far-off pixel does not fit an integer, nor does what is not a number.
    u, v = torch.minimum((pixels.round() + BORDER_PX).nan_to_num(0.0).clamp(min=0), limit).long().unbind(-1)
    return image.flatten()[v * image.shape[1] + u]
