"""Shared by several tests: ball, l_prism."""

import numpy as np
import trimesh


def l_prism():
    """An L-shaped bar: concave, twenty faces, the outside seen anticlockwise."""
    outline = np.array([[0, 0], [0.12, 0], [0.12, 0.04], [0.04, 0.04], [0.04, 0.12], [0, 0.12]]) - 0.04
    low, high = (np.column_stack([outline, np.full(6, z)]) for z in (-0.03, 0.03))
    cap = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    faces = [[a + 6 for a in face] for face in cap] + [face[::-1] for face in cap]
    for i in range(6):
        j = (i + 1) % 6
        faces += [[i, j, j + 6], [i, j + 6, i + 6]]
    return trimesh.Trimesh(np.concatenate([low, high]), faces, process=False)


def ball(radius_m, centre=(0.0, 0.0, 0.0), subdivisions=3):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_m).apply_translation(centre)
