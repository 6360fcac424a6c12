"""Even samples of a surface."""

import numpy as np

from torchtrack.object_model.surface import Surface


def sample_surface(surface: Surface, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """``count`` points and their unit normals, each ``[N, 3]``: uniform over the area, the same every time.

    Areas are stratified: each sample has an equal share of the area to itself, which is more even than independent draws.
    """
    rng = np.random.default_rng(seed)
    corners = surface.corners
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    cumulative = np.cumsum(area)
    face = np.searchsorted(cumulative, (np.arange(count) + rng.random(count)) / count * cumulative[-1], side="right").clip(max=len(area) - 1)
    root, along = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = corners[face].transpose(1, 0, 2)
    return (1 - root) * a + root * (1 - along) * b + root * along * c, surface.normals[face]
