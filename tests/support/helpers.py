"""Random inputs for tests, from CPU generators with fixed seeds, and small scenes with known truth."""

from collections.abc import Sequence
from functools import cache

import torch
import trimesh
from torch import Tensor

from torchtrack.core.camera import Camera, project
from torchtrack.core.events import EventBatch
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.core.lie import rotation_angle_deg, se3_exp, so3_exp, transform_points
from torchtrack.io import Trajectory
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.points import Contours


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator(device="cpu").manual_seed(seed)


def random_twist(*batch: int, seed: int = 0, rotation_rad: float = 1.0, translation_m: float = 0.1, dtype=torch.float64) -> Tensor:
    """Twists ``[*batch, 6]`` whose parts are normally distributed with the given deviations."""
    scale = torch.tensor([rotation_rad] * 3 + [translation_m] * 3, dtype=dtype)
    return torch.randn((*batch, 6), generator=generator(seed), dtype=dtype) * scale


def rotation_vectors(angle: float, *batch: int, seed: int = 0, dtype=torch.float64) -> Tensor:
    """Vectors ``[*batch, 3]`` of one length (rad), with axes all over the sphere."""
    axis = torch.randn((*batch, 3), generator=generator(seed), dtype=torch.float64)
    return (angle * axis / axis.norm(dim=-1, keepdim=True)).to(dtype)


def far_from(T: Tensor, other: Tensor) -> float:
    """The largest difference of any two entries."""
    return float((T - other).abs().max()) if T.numel() else 0.0


def random_pose(*batch: int, seed: int = 0, depth_m: tuple[float, float] = (0.4, 0.8), spread_m: float = 0.05, dtype=torch.float64) -> Tensor:
    """Poses ``[*batch, 4, 4]`` of objects in front of the camera, with rotations spread over all of SO(3)."""
    rng = generator(seed)
    T = torch.eye(4, dtype=dtype).repeat(*batch, 1, 1)
    T[..., :3, :3] = so3_exp(torch.randn((*batch, 3), generator=rng, dtype=dtype) * 2)
    T[..., :2, 3] = torch.randn((*batch, 2), generator=rng, dtype=dtype) * spread_m
    T[..., 2, 3] = depth_m[0] + torch.rand(batch, generator=rng, dtype=dtype) * (depth_m[1] - depth_m[0])
    return T


def perturbed(T: Tensor, seed: int = 0, rotation_rad: float = 0.01, translation_m: float = 0.001) -> Tensor:
    """Poses moved by small random twists on the left."""
    return se3_exp(random_twist(*T.shape[:-2], seed=seed, rotation_rad=rotation_rad, translation_m=translation_m, dtype=T.dtype)) @ T


def random_events(count: int, *, width: int = 64, height: int = 48, duration_us: int = 10_000, seed: int = 0, stream: int = 0) -> EventBatch:
    """Events spread evenly over sensor and time, sorted by time."""
    rng = generator(seed)
    x = torch.randint(width, (count,), generator=rng).numpy()
    y = torch.randint(height, (count,), generator=rng).numpy()
    t_us = torch.randint(1, duration_us + 1, (count,), generator=rng).sort().values.numpy()
    polarity = torch.randint(2, (count,), generator=rng).numpy()
    return EventBatch.from_numpy(x, y, t_us, polarity, stream)


# ---- small scenes for the pipeline

SMALL_CAMERA = Camera(fx=250.0, fy=250.0, cx=99.5, cy=74.5, width=200, height=150)
BOX_EXTENTS_M = (0.12, 0.10, 0.08)


@cache
def box_model(extents_m: tuple[float, float, float] = BOX_EXTENTS_M) -> ObjectModel:
    return ObjectModel.from_mesh(trimesh.creation.box(extents_m), name="box")


def bevelled_model(extents_m: tuple[float, float, float] = BOX_EXTENTS_M, bevel_m: float = 0.001) -> ObjectModel:
    """A box whose edges are bevelled: its events are a box's, and its contours those of what is smooth."""
    half = torch.tensor(extents_m, dtype=torch.float64) / 2
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
    inset = half - bevel_m
    points = torch.cat([corners * torch.where(torch.arange(3) == axis, half, inset) for axis in range(3)])
    return ObjectModel.from_mesh(trimesh.convex.convex_hull(points.numpy()), name="bevelled")


def pose(rotation: Sequence[float] = (0.5, 0.6, 0.1), translation: Sequence[float] = (0.0, 0.0, 0.5), dtype=torch.float64) -> Tensor:
    """A pose ``[4, 4]`` from a rotation vector (rad) and a translation (m)."""
    T = torch.eye(4, dtype=dtype)
    T[:3, :3] = so3_exp(torch.tensor(rotation, dtype=dtype))
    T[:3, 3] = torch.tensor(translation, dtype=dtype)
    return T


def drifting(
    T_start: Tensor,
    duration_us: int,
    *,
    turn: Sequence[float] = (0.8, -0.5, 1.2),
    move: Sequence[float] = (0.15, 0.1, 0.1),
    step_us: int = 250,
    start_us: int = 0,
) -> Trajectory:
    """A body that turns about its own origin (rad/s) while this moves (m/s), both constant in the camera's axes."""
    t_us = torch.arange(0, duration_us + 1, step_us)
    seconds = 1e-6 * t_us.double()[:, None]
    T = T_start.repeat(len(t_us), 1, 1)
    T[:, :3, :3] = so3_exp(seconds * torch.tensor(turn, dtype=torch.float64)) @ T_start[:3, :3]
    T[:, :3, 3] = T_start[:3, 3] + seconds * torch.tensor(move, dtype=torch.float64)
    return Trajectory(t_us + start_us, T)


def edge_events(
    trajectory: Trajectory, camera: Camera = SMALL_CAMERA, extents_m: tuple[float, float, float] = BOX_EXTENTS_M, *, seed: int = 0, stream: int = 0
) -> EventBatch:
    """An event wherever a visible edge of a moving box passes the centre of a pixel, at that very time.

    Along each edge every row (of an upright edge; every column of a level one) fires on its own, as pixels do; the
    polarity is random. Exact but for the time step of the trajectory, and without noise.
    """
    mesh = trimesh.creation.box(extents_m)
    sharp = mesh.face_adjacency_angles > 0.5
    ends = torch.from_numpy(mesh.vertices[mesh.face_adjacency_edges[sharp]].copy())
    normals = torch.from_numpy(mesh.face_normals[mesh.face_adjacency[sharp]].copy())
    T = trajectory.T_cam_obj
    ends_cam = transform_points(T, ends.reshape(1, -1, 3).expand(len(T), -1, -1)).unflatten(1, (-1, 2))
    facing = ((normals @ T[:, None, :3, :3].transpose(-1, -2)) * ends_cam[:, :, :1]).sum(-1) < 0
    visible = facing.any(-1)
    pixels = project(ends_cam.flatten(1, 2), camera.intrinsics(torch.float64).expand(len(T), 4)).unflatten(1, (-1, 2))
    crossings_of_edges = [_crossings(pixels[:, edge], visible[:, edge], trajectory.t_us, camera) for edge in range(len(ends))]
    u, v, t_us = torch.cat(crossings_of_edges, 1)
    t_us, order = t_us.sort(stable=True)
    polarity = torch.randint(2, (len(t_us),), generator=generator(seed))
    return EventBatch.from_numpy(u[order].numpy(), v[order].numpy(), t_us.numpy(), polarity.numpy(), stream)


def _crossings(ends: Tensor, visible: Tensor, t_us: Tensor, camera: Camera) -> Tensor:
    """u, v and time ``[3, e]`` of the pixels that one projected edge, ``ends [t, 2, 2]``, passes."""
    span = (ends[:, 1] - ends[:, 0]).abs()
    crossings = []
    for across, size in ((0, camera.height), (1, camera.width)):
        steep = visible & (span[:, 1 - across] > span[:, across])
        lines = torch.arange(size, dtype=torch.float64)
        first, last = ends[:, 0], ends[:, 1]
        along = (lines - first[:, 1 - across, None]) / (last - first)[:, 1 - across, None]
        place = first[:, across, None] + along * (last - first)[:, across, None]
        exists = steep[:, None] & (along >= 0) & (along <= 1)
        passed = (place[1:].floor() != place[:-1].floor()) & exists[1:] & exists[:-1]
        step, line = torch.nonzero(passed, as_tuple=True)
        before, after = place[step, line], place[step + 1, line]
        at = torch.maximum(before, after).floor()
        time = t_us[step] + (t_us[step + 1] - t_us[step]) * (at - before) / (after - before)
        pixel = [at.long(), line] if across == 0 else [line, at.long()]
        crossings.append(torch.stack([*pixel, time.ceil().long()]))
    u, v, _ = every = torch.cat(crossings, 1)
    return every[:, (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)]


def pose_errors(T_found: Tensor, T_true: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (degrees) and translation (mm) between poses ``[..., 4, 4]``."""
    return rotation_angle_deg(T_found[..., :3, :3], T_true[..., :3, :3]), 1e3 * (T_found - T_true)[..., :3, 3].norm(dim=-1)


# ---- contours and observations at given pixels

IMAGE_SIZE = (150, 200)


def contours_at(pixels, normals=None, kind=ContourKind.CREASE, mask=None, dtype=torch.float64):
    """Contours ``[b, m]`` at given pixels, all at a depth of one metre."""
    pixels = torch.as_tensor(pixels, dtype=dtype)
    normals = torch.tensor([1.0, 0.0], dtype=dtype).expand_as(pixels) if normals is None else torch.as_tensor(normals, dtype=dtype)
    points = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1)
    mask = torch.ones(pixels.shape[:2], dtype=torch.bool) if mask is None else torch.as_tensor(mask)
    return Contours(
        points, torch.zeros_like(points), torch.full(mask.shape, int(kind)), mask, points, pixels, normals, torch.ones_like(points[..., 0])
    )


def moving_objects(velocity_px_s, batch=1, dtype=torch.float64):
    """Objects that show contours of :func:`contours_at` where they are, and move across the image at ``velocity_px_s``."""
    centre = torch.tensor([0.0, 0.0, 1.0], dtype=dtype).expand(batch, 3)
    intrinsics = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=dtype).expand(batch, 4)
    velocity = torch.zeros(batch, 6, dtype=dtype)
    velocity[:, 3:5] = torch.as_tensor(velocity_px_s, dtype=dtype)
    return MovingObjects(torch.eye(4, dtype=dtype).expand(batch, 4, 4), velocity, centre, intrinsics)


def upright_line(u, dtype=torch.float64, **kwargs):
    """Points every pixel on the line at ``u``, whose normal is (1, 0)."""
    v = torch.arange(20.0, 120.0, dtype=dtype)
    return contours_at(torch.stack([torch.full_like(v, u), v], -1)[None], dtype=dtype, **kwargs)


def seen(pixels, *, age_s=0.0, polarity=0.0, flow=None, mask=None, dtype=torch.float64):
    """Observations ``[b, n]``."""
    pixels = torch.as_tensor(pixels, dtype=dtype)
    mask = torch.ones(pixels.shape[:2], dtype=torch.bool) if mask is None else torch.as_tensor(mask)
    flow = torch.zeros_like(pixels) if flow is None else torch.as_tensor(flow, dtype=dtype).expand_as(pixels)
    age, polarity = (torch.as_tensor(value, dtype=dtype).expand(mask.shape) for value in (age_s, polarity))
    return Observations(pixels, age, polarity, mask, flow, flow.norm(dim=-1) > 0)
