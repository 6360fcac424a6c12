"""A sequence small enough to track in a blink: a box whose edges fire as they move over the pixels."""

from pathlib import Path

import numpy as np
import torch
import trimesh

from torchtrack.core.camera import Camera, project
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import se3_exp, so3_exp, transform_points
from torchtrack.io import LabelledMesh, Trajectory, write_sequence

CAMERA = Camera(fx=150.0, fy=150.0, cx=59.5, cy=44.5, width=120, height=90)


def true_poses(duration_us: int, step_us: int = 500) -> Trajectory:
    """A box half a metre away that drifts and turns with constant twist."""
    t_us = torch.arange(0, duration_us + 1, step_us)
    start = torch.eye(4, dtype=torch.float64)
    start[:3, :3] = so3_exp(torch.tensor([0.5, 0.6, 0.1], dtype=torch.float64))
    start[:3, 3] = torch.tensor([0.0, 0.0, 0.5])
    turn = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    centre = start[:3, 3]
    velocity = torch.cat([turn, torch.tensor([0.1, 0.06, 0.0], dtype=torch.float64) - torch.linalg.cross(turn, centre)])
    return Trajectory(t_us, se3_exp(1e-6 * t_us.double()[:, None] * velocity) @ start)


def box_events(mesh: trimesh.Trimesh, trajectory: Trajectory) -> EventBatch:
    """An event wherever a point on an edge comes to a new pixel, brighter and darker in turn."""
    ends = torch.from_numpy(mesh.vertices[mesh.face_adjacency_edges[mesh.face_adjacency_angles > 0.5]].copy())
    along = torch.linspace(0, 1, 60, dtype=torch.float64)[:, None]
    points = (ends[:, :1] * (1 - along) + ends[:, 1:] * along).reshape(-1, 3)
    count = len(trajectory)
    in_camera = transform_points(trajectory.T_cam_obj, points.expand(count, -1, 3))
    pixels = project(in_camera, CAMERA.intrinsics(torch.float64).expand(count, 4)).round().int()
    step, point = torch.nonzero((pixels[1:] != pixels[:-1]).any(-1), as_tuple=True)
    inside = ((pixels >= 0) & (pixels < torch.tensor([CAMERA.width, CAMERA.height]))).all(-1)[step + 1, point]
    step, point = step[inside] + 1, point[inside]
    x, y = pixels[step, point].unbind(-1)
    return EventBatch.from_numpy(x.numpy(), y.numpy(), trajectory.t_us[step].numpy(), np.arange(len(step)) % 2)


def write_tiny_sequence(folder: Path, name: str = "tiny", labels: tuple[str, ...] = ("box",), duration_us: int = 60_000) -> Path:
    """``NAME.npz`` in ``folder``; objects after the first have the same mesh and motion."""
    mesh = trimesh.creation.box((0.12, 0.1, 0.08))
    trajectory = true_poses(duration_us)
    path = folder / f"{name}.npz"
    write_sequence(path, box_events(mesh, trajectory), CAMERA, [LabelledMesh(label, mesh, trajectory) for label in labels])
    return path
