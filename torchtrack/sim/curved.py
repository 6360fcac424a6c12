"""Curved objects made by code: metres, origin at the centre, faces wound outwards, 10 to 20 cm across."""

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray

from torchtrack.sim import implicit


def torus_knot(size_m: float = 0.15, tube_m: float = 0.017, winds: tuple[int, int] = (2, 3), steps: tuple[int, int] = (260, 20)) -> trimesh.Trimesh:
    """A tube along a knot on a torus (a trefoil for 2 and 3)."""
    turns, waves = winds
    t = np.linspace(0, 2 * np.pi, steps[0], endpoint=False)

    def line(angle: Float[ndarray, "n"]) -> Float[ndarray, "n 3"]:
        radius = 2 + np.cos(waves * angle)
        return np.stack([radius * np.cos(turns * angle), radius * np.sin(turns * angle), -np.sin(waves * angle)], -1)

    scale = (size_m / 2 - tube_m) / 3
    centre, tangent = scale * line(t), line(t + 1e-4) - line(t - 1e-4)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # Frames from the direction to the axis of the torus come back to where they began after a round.
    across = np.cross(tangent, centre)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    around = np.linspace(0, 2 * np.pi, steps[1], endpoint=False)[:, None]
    rings = centre[:, None] + tube_m * (np.cos(around) * across[:, None] + np.sin(around) * np.cross(tangent, across)[:, None])
    return _closed_grid(rings, closed_lengthwise=True)


def vase(height_m: float = 0.18, radius_m: float = 0.06, steps: tuple[int, int] = (72, 96)) -> trimesh.Trimesh:
    """A turned vase: a wavy profile about the y axis, with closed ends."""
    share = np.linspace(0, 1, steps[0])
    profile = radius_m * (0.62 + 0.38 * np.sin(2 * np.pi * (0.95 * share + 0.06)) - 0.1 * share)
    height = height_m * (share - 0.5)
    # Rings that close in on the axis make the ends.
    profile, height = np.concatenate([[1e-4], profile, [1e-4]]), np.concatenate([height[:1], height, height[-1:]])
    angle = np.linspace(0, 2 * np.pi, steps[1], endpoint=False)
    rings = np.stack(
        [profile[:, None] * np.cos(angle), np.broadcast_to(height[:, None], (len(height), steps[1])), profile[:, None] * np.sin(angle)], -1
    )
    return _closed_grid(rings, closed_lengthwise=False)


def mug(height_m: float = 0.11, radius_m: float = 0.042, wall_m: float = 0.005, cell_m: float = 0.0029) -> trimesh.Trimesh:
    """A mug with a handle."""
    half = height_m / 2
    body = implicit.rounded_cylinder(radius_m, -half, half, 0.5 * wall_m)
    handle = implicit.ring((radius_m + 0.006, 0.0, 0.0), 0.027, 0.0065)
    hollow = implicit.rounded_cylinder(radius_m - wall_m, -half - 1.0, half - 1.6 * wall_m, 0.004)
    # The open side looks to -y, which is up in the camera's frame.
    field = implicit.without(implicit.union(body, handle, blend=0.008), hollow, blend=0.002)
    return _centred(implicit.surface(field, (-radius_m, -half, -radius_m), (radius_m + 0.05, half, radius_m), cell_m))


def animal(cell_m: float = 0.0026) -> trimesh.Trimesh:
    """A blob of an animal: body, head, snout, ears, four legs and a tail, melted into one another."""
    parts = [
        implicit.ellipsoid((0.0, 0.0, 0.0), (0.062, 0.038, 0.036)),
        implicit.sphere((0.062, -0.034, 0.0), 0.027),
        implicit.capsule((0.070, -0.030, 0.0), (0.096, -0.022, 0.0), 0.014, 0.010),
        implicit.capsule((0.052, -0.052, 0.016), (0.044, -0.078, 0.026), 0.009, 0.005),
        implicit.capsule((0.052, -0.052, -0.016), (0.044, -0.078, -0.026), 0.009, 0.005),
        implicit.capsule((-0.055, -0.012, 0.0), (-0.085, -0.046, 0.006), 0.009, 0.006),
        *(
            implicit.capsule((x, 0.02, z), (1.12 * x, 0.066, 1.1 * z), 0.014, 0.010)
            for x, z in ((0.036, 0.021), (0.036, -0.021), (-0.038, 0.021), (-0.038, -0.021))
        ),
    ]
    return _centred(implicit.surface(implicit.union(*parts, blend=0.02), (-0.1, -0.09, -0.05), (0.115, 0.085, 0.05), cell_m))


def duck(cell_m: float = 0.0028) -> trimesh.Trimesh:
    """A bath duck: body, head, beak, wings and tail."""
    parts = [
        implicit.ellipsoid((0.0, 0.0, 0.0), (0.065, 0.040, 0.045)),
        implicit.sphere((0.038, -0.058, 0.0), 0.031),
        implicit.ellipsoid((-0.062, -0.028, 0.0), (0.022, 0.014, 0.018)),
        implicit.ellipsoid((-0.008, -0.006, 0.042), (0.034, 0.020, 0.012)),
        implicit.ellipsoid((-0.008, -0.006, -0.042), (0.034, 0.020, 0.012)),
    ]
    beak = implicit.ellipsoid((0.074, -0.052, 0.0), (0.018, 0.007, 0.016))
    field = implicit.union(implicit.union(*parts, blend=0.015), beak, blend=0.004)
    return _centred(implicit.surface(field, (-0.09, -0.095, -0.06), (0.1, 0.045, 0.06), cell_m))


def robot(cell_m: float = 0.0025) -> trimesh.Trimesh:
    """A figure of capsules: body, head, arms and legs in a pose without symmetry."""
    limbs = [
        ((0.0, -0.025, 0.0), (0.0, 0.025, 0.0), 0.027),
        ((0.0, -0.062, 0.0), (0.006, -0.070, 0.0), 0.020),
        ((0.028, -0.026, 0.0), (0.062, -0.046, 0.014), 0.0095),
        ((0.062, -0.046, 0.014), (0.066, -0.078, 0.018), 0.0085),
        ((-0.028, -0.026, 0.0), (-0.054, 0.004, -0.008), 0.0095),
        ((-0.054, 0.004, -0.008), (-0.046, 0.032, 0.012), 0.0085),
        ((0.014, 0.040, 0.0), (0.020, 0.088, 0.006), 0.012),
        ((-0.014, 0.040, 0.0), (-0.026, 0.084, -0.014), 0.012),
        ((0.0, -0.085, 0.0), (0.0, -0.098, 0.0), 0.0035),
    ]
    field = implicit.union(*(implicit.capsule(*limb) for limb in limbs), blend=0.006)
    return _centred(implicit.surface(field, (-0.075, -0.11, -0.04), (0.085, 0.11, 0.04), cell_m))


def _closed_grid(rings: Float[ndarray, "n m 3"], *, closed_lengthwise: bool) -> trimesh.Trimesh:
    """Rings of points joined to a surface; the last to the first where asked, else both ends are capped by their narrow rings."""
    count, around, _ = rings.shape
    ring, step = np.meshgrid(np.arange(count if closed_lengthwise else count - 1), np.arange(around), indexing="ij")
    after, next_step = (ring + 1) % count, (step + 1) % around
    a, b, c, d = (i * around + j for i, j in ((ring, step), (after, step), (after, next_step), (ring, next_step)))
    faces = [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    if not closed_lengthwise:
        fan = np.stack([np.zeros(around - 2, int), np.arange(1, around - 1), np.arange(2, around)], 1)
        faces += [fan, fan[:, ::-1] + (count - 1) * around]
    mesh = trimesh.Trimesh(rings.reshape(-1, 3), np.concatenate(faces), process=False)
    if mesh.volume < 0:
        mesh.invert()
    return _centred(mesh)


def _centred(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.apply_translation(-mesh.bounds.mean(0))
    return mesh
