"""Shared by several tests: nearest."""

import torch
from helpers import IMAGE_SIZE, moving_objects

from torchtrack.config.components import Component
from torchtrack.config.tracker import AssociationConfig, TrackerConfig
from torchtrack.tracking.association.nearest import Gate, contour_table, match_nearest
from torchtrack.tracking.contours.index import index_contours

UNSHIFTED = frozenset({Component.DARK_SHIFT, Component.SILHOUETTE_DARK_SHIFT})


def matching(*, shifted=False, **settings):
    """Settings without what corrects and weights the matches, unless it is asked for."""
    association = AssociationConfig(**{"concentration": False, "polarity": False, **settings})
    return TrackerConfig(association=association, disabled=frozenset() if shifted else UNSHIFTED)


def nearest(observations, contours, *, velocity=(0.0, 0.0), believed=None, gate_px=3.0, index=None, cell_px=1, **settings):
    """The matches of ``match_nearest``, with all contours moving at ``velocity`` (px/s)."""
    dtype = contours.pixels.dtype
    moving = moving_objects(velocity, len(contours.pixels), dtype)
    believed = torch.as_tensor(velocity if believed is None else believed, dtype=dtype)
    table = contour_table(contours, index or index_contours(contours, IMAGE_SIZE, 8, cell_px))
    place = observations.pixels + believed * observations.age_s[..., None]
    return match_nearest(observations, table, place, moving, Gate(gate_px), matching(**settings))
