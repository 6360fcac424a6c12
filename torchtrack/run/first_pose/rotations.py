"""Which rotations are tried: all of them, or those around one."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.lie import so3_exp
from torchtrack.tracking.relocalization.view_sphere import rotations_from, view_directions

# Directions that the camera sees an object from, and rotations about the line of sight: about nine degrees apart.
_VIEWS, _ROLLS = 500, 36


def all_rotations() -> Float[Tensor, "n 3 3"]:
    """Rotations ``R_cam_obj`` all around, evenly spread (float64)."""
    angles = torch.arange(_ROLLS, dtype=torch.float64) * (2 * math.pi / _ROLLS)
    about_sight = so3_exp(torch.stack([torch.zeros_like(angles), torch.zeros_like(angles), angles], -1))
    return torch.einsum("rij,vjk->vrik", about_sight, rotations_from(view_directions(_VIEWS))).flatten(0, 1)


def rotations_around(rotation: Float[Tensor, "3 3"], radius_deg: float, step_deg: float) -> Float[Tensor, "n 3 3"]:
    """Rotations up to an angle away from one, on a grid of rotation vectors (float64); itself among them."""
    count = math.floor(radius_deg / step_deg)
    along = torch.arange(-count, count + 1, dtype=torch.float64) * math.radians(step_deg)
    vectors = torch.cartesian_prod(along, along, along)
    vectors = vectors[vectors.norm(dim=-1) <= math.radians(radius_deg) + 1e-9]
    return so3_exp(vectors) @ rotation.double()
