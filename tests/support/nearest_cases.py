"""Shared by several tests: nearest."""

import torch
from helpers import IMAGE_SIZE, moving_objects

from torchtrack.config.tracker import AssociationConfig
from torchtrack.tracking.association.nearest import contour_table, match_nearest
from torchtrack.tracking.contours.index import index_contours


def matching(**settings):
    """Settings without what corrects and weights the matches, unless it is asked for."""
    return AssociationConfig(**{"dark_shift_px": 0.0, "silhouette_dark_shift_px": 0.0, "concentration": False, "polarity": False, **settings})


def nearest(observations, contours, *, velocity=(0.0, 0.0), believed=None, gate_px=3.0, index=None, cell_px=1, **settings):
    """The matches of ``match_nearest``, with all contours moving at ``velocity`` (px/s)."""
    dtype = contours.pixels.dtype
    moving = moving_objects(velocity, len(contours.pixels), dtype)
    believed = torch.as_tensor(velocity if believed is None else believed, dtype=dtype)
    table = contour_table(contours, index or index_contours(contours, IMAGE_SIZE, 8, cell_px))
    place = observations.pixels + believed * observations.age_s[..., None]
    return match_nearest(observations, table, place, moving, gate_px, matching(**settings))
