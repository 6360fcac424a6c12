"""The events of a window as an image with a border, in which poses are looked for."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchtrack.core.constants import constant

# Pixels of each object's events at the window's end, and which of them exist.
Places = tuple[Float[Tensor, "k e 2"], Bool[Tensor, "k e"]]
# Pixels around the image that events and contours may lie in.
BORDER_PX = 2


def event_density(pixels: Float[Tensor, "k e 2"], mask: Bool[Tensor, "k e"], image_size: tuple[int, int]) -> Float[Tensor, "k h w"]:
    """Events of each row in the 3x3 pixels around every pixel of the image with its border."""
    height, width = (size + 2 * BORDER_PX for size in image_size)
    place = (pixels.round() + BORDER_PX).nan_to_num(-1)
    inside = mask & (place >= 1).all(-1) & (place[..., 0] < width - 1) & (place[..., 1] < height - 1)
    u, v = torch.where(inside[..., None], place, 0).long().unbind(-1)
    image = torch.zeros(len(pixels), height * width, dtype=pixels.dtype, device=pixels.device)
    image = image.scatter_add(1, v * width + u, inside.to(pixels.dtype)).unflatten(1, (height, width))
    rows = image[:, :-2] + image[:, 1:-1] + image[:, 2:]
    return pad(rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:], (1, 1, 1, 1))


def look_up(images: Float[Tensor, "k h w"], number: Int[Tensor, "n"], pixels: Float[Tensor, "n *m 2"]) -> Float[Tensor, "n *m"]:
    """What images with their borders have at some pixels; outside of them, what is at the rim.

    Args:
        number: of the image that each row is looked up in.
    """
    height, width = images.shape[1:]
    limit = constant((width - 1, height - 1), images.dtype, images.device)
    # Clamped before the conversion: a far-off pixel does not fit an integer, nor does what is not a number.
    u, v = torch.minimum((pixels.round() + BORDER_PX).nan_to_num(0.0).clamp(min=0), limit).long().unbind(-1)
    first = (number * (height * width)).view(-1, *[1] * (u.dim() - 1))
    return images.flatten()[first + v * width + u]
